"""Which views are kept, and the first reason against the others."""

import numpy as np
import pytest

from sl_nerfstudio.capture.grid_view import GridView
from sl_nerfstudio.capture.light import Light
from sl_nerfstudio.capture.selection import Selection, Verdict

GOOD = Light(0.0, 0.0)


def view(shift=0.0, nodes=100, blur=0.1, light=GOOD, edge=None):
    uv = np.full((10, 10, 2), np.nan, dtype=np.float32)
    x, y = np.meshgrid(np.arange(10) * 10.0, np.arange(10) * 10.0)
    uv.reshape(-1, 2)[:nodes] = np.stack([x.ravel() + shift, y.ravel()], -1)[:nodes]
    return GridView(uv, 10.0, blur, light, edge)


@pytest.mark.parametrize(
    ("seen", "verdict"),
    [
        (view(), Verdict.KEEP),
        (view(nodes=47), Verdict.NO_PATTERN),
        (view(nodes=0, light=Light(0.6, 0.0)), Verdict.SATURATED),
        (view(nodes=0, light=Light(0.0, 0.95)), Verdict.DARK),
        (view(nodes=0, edge=2.5), Verdict.BLURRED),
        (view(nodes=0, edge=0.9), Verdict.NO_PATTERN),
        (view(blur=0.16), Verdict.BLURRED),
        (view(blur=None), Verdict.BLURRED),
        (view(light=Light(0.2, 0.0)), Verdict.SATURATED),
        (view(light=Light(0.0, 0.4)), Verdict.DARK),
        (GridView(np.zeros((0, 0, 2), dtype=np.float32), 1.0, None, GOOD), Verdict.BY_KEY),
    ],
)
def test_the_first_view(seen, verdict):
    assert Selection((10, 10)).judge(seen, 0.0) is verdict


def test_views_that_are_known_are_not_kept_again_even_later():
    selection = Selection((10, 10))
    for shift in (0.0, 50.0):
        selection.add(view(shift), 0.0)
    assert selection.judge(view(1.0), 60.0) is Verdict.KNOWN  # like the first, not the last
    assert selection.judge(view(25.0), 60.0) is Verdict.KEEP


def test_after_a_frame_there_is_a_pause():
    selection = Selection((10, 10))
    selection.add(view(), 5.0)
    assert selection.judge(view(30.0), 5.9) is Verdict.WAIT and selection.judge(view(30.0), 6.0) is Verdict.KEEP


def test_frames_of_an_earlier_run_cause_no_pause():
    selection = Selection((10, 10))
    selection.add(view())
    assert selection.judge(view(30.0), 0.0) is Verdict.KEEP


def test_how_often_each_node_was_seen():
    selection = Selection((10, 10))
    assert selection.times_seen.tolist() == np.zeros((10, 10)).tolist()
    for nodes in (100, 20, 10):
        selection.add(view(nodes=nodes))
    assert selection.times_seen[:4].sum(1).tolist() == [30, 20, 10, 10]
