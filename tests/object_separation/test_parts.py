"""Connected parts: what belongs to the object although a gap separates it, and what does not."""

import numpy as np
import pytest

from sl_nerfstudio.object_separation.planes import SEPARATION_DEFAULTS, Plane, ViewedRegion
from sl_nerfstudio.object_separation.separate import find_object

TABLE = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
REGION = ViewedRegion(np.array([0.0, 0.0, 50.0]), 80.0)
SIZE = 2.0


def _block(x, y, z, step=0.9):
    axes = [np.arange(low + 0.01, high, step) for low, high in (x, y, z)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


BODY = _block((-20, 20), (-20, 20), (30, 80))


@pytest.mark.parametrize(
    ("part", "belongs"),
    [
        (_block((-5, 5), (-5, 5), (1, 22)), True),  # a foot below the body; what is between was not decoded
        (_block((28, 40), (-5, 5), (40, 50)), True),  # a handle that floats beside it
        (_block((28, 40), (-5, 5), (1, 50)), False),  # another thing, standing beside it
        (_block((75, 90), (-5, 5), (40, 50)), False),  # floating, but far away
        (_block((-2, 2), (-2, 2), (86, 88)), False),  # a speck: too small for a part
    ],
)
def test_what_belongs_to_the_body(part, belongs):
    found = find_object([np.concatenate([BODY, part])] * 2, [TABLE], REGION, SIZE, SEPARATION_DEFAULTS)
    assert found.contain(BODY).all()
    assert found.contain(part).mean() == pytest.approx(float(belongs), abs=0.02)


def test_the_cameras_decide_which_of_two_things_is_the_object():
    """The other one is larger, but beside the common view."""
    other = _block((150, 230), (-40, 40), (1, 60), 1.5)
    found = find_object([np.concatenate([BODY, other])] * 2, [TABLE], REGION, SIZE, SEPARATION_DEFAULTS)
    assert found.contain(BODY).all() and not found.contain(other).any()


def test_stray_points_of_one_frame_are_not_the_object():
    stray = np.random.default_rng(0).uniform(-200, 200, (300, 3))
    frames = [np.concatenate([BODY, stray]), BODY]
    found = find_object(frames, [], REGION, SIZE, SEPARATION_DEFAULTS)
    far = np.abs(stray - [0, 0, 55]).max(1) > 40
    assert found.contain(BODY).all() and not found.contain(stray[far]).any()


def test_without_points_there_is_no_object():
    found = find_object([np.zeros((0, 3))], [], REGION, SIZE, SEPARATION_DEFAULTS)
    assert not found.contain(BODY[:5]).any() and len(found.contain(np.zeros((0, 3)))) == 0
