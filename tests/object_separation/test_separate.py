"""The object is kept, and what surrounds it left out, in frames as noisy as real ones."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.object_separation.planes import DecodedFrame, Plane, ViewedRegion, points_of
from sl_nerfstudio.object_separation.separate import Part, find_object, separate, silhouette


def _shares(case, found):
    """Shares of the object's and of the surroundings' decoded pixels that are kept."""
    kept = [found.parts(k, frame) == Part.OBJECT for k, frame in enumerate(case.frames)]
    decoded = [np.isfinite(frame.coords).all(-1) for frame in case.frames]
    own = [(k & d & o).sum() / (d & o).sum() for k, d, o in zip(kept, decoded, case.is_object, strict=True)]
    others = sum(int((d & ~o).sum()) for d, o in zip(decoded, case.is_object, strict=True))
    left = sum(int((k & d & ~o).sum()) for k, d, o in zip(kept, decoded, case.is_object, strict=True))
    return np.mean(own), left / max(others, 1)


@pytest.mark.parametrize(
    ("name", "background"),
    [
        ("box", "table"),
        *(
            pytest.param(name, background, marks=pytest.mark.slow)
            for name, background in itertools.product(("box", "medal"), ("table", "walls", "room", "plate"))
            if (name, background) != ("box", "table")
        ),
    ],
)
def test_the_object_stays_and_its_surroundings_go(cases, separated, name, background):
    case, found = cases(name, background), separated(name, background)
    own, left = _shares(case, found)
    assert own > 0.985 and left < 0.01
    assert len(found.surroundings) >= 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["box", "medal", "plaque", "cone-and-cylinder"])
def test_nothing_is_taken_from_an_object_without_surroundings(cases, separated, name):
    """Flat sides, a flat object, and a plate with solids on it: their planes are part of them."""
    case, found = cases(name, "none"), separated(name, "none")
    assert found.findings and not found.surroundings
    assert _shares(case, found)[0] > 0.99


def test_what_was_seen_but_not_decoded_is_as_its_neighbours(cases, separated):
    case, found = cases("box", "table"), separated("box", "table")
    frame = case.frames[0]
    parts = found.parts(0, frame)
    assert ((parts != Part.NOTHING) == frame.seen).all()
    gaps = frame.seen & ~np.isfinite(frame.coords).all(-1)
    right = (parts == Part.OBJECT)[gaps] == case.is_object[0][gaps]
    assert gaps.sum() > 500 and right.mean() > 0.97


def test_points_of_a_surface_are_judged_like_pixels(separated):
    """On top of the box and on the table, 40 mm beside it; the table is at z = 0."""
    found = separated("box", "table")
    x, y = np.meshgrid(np.linspace(-30, 30, 9), np.linspace(-20, 20, 9))
    top = np.stack([x, y, np.full_like(x, 90.0)], -1).reshape(-1, 3)
    beside = np.stack([np.full(9, 75.0), np.linspace(-20, 20, 9), np.zeros(9)], -1)
    assert found.keeps(top).all() and not found.keeps(beside).any()
    assert not found.keeps(np.array([[0.0, 0.0, 500.0], [900.0, 0.0, 40.0]])).any()


@pytest.mark.slow
def test_the_same_frames_and_seed_give_the_same_answer(cases, separated):
    frames = cases("box", "table").frames
    first, second = separated("box", "table"), separate(frames)
    for k, frame in enumerate(frames):
        np.testing.assert_array_equal(first.parts(k, frame), second.parts(k, frame))


@pytest.mark.slow
def test_lengths_have_no_say(cases):
    """In metres, and moved and turned as a whole, the answer is the same."""
    case = cases("box", "table")
    S = Similarity(0.001, Rotation.from_rotvec([0.0, 0.7, 0.0]).as_matrix(), np.array([5.0, -3.0, 2.0]))
    frames = tuple(
        replace(f, T_world_camera=S.poses(f.T_world_camera), T_world_projector=S.poses(f.T_world_projector))
        for f in case.frames
    )
    other = replace(case, frames=frames)
    own, left = _shares(other, separate(frames))
    assert own > 0.985 and left < 0.01


@pytest.mark.slow
def test_with_hardly_anything_but_a_table_nothing_is_left_out(cases):
    """The object's pixels are removed beforehand, but for a few."""
    case = cases("box", "table")
    frames = []
    for frame, is_object in zip(case.frames, case.is_object, strict=True):
        coords = frame.coords.copy()
        coords[is_object] = np.nan
        frames.append(replace(frame, coords=coords, seen=frame.seen & ~is_object))
    found = separate(frames)
    assert not found.surroundings
    kept = [found.parts(k, f)[points_of(f).row, points_of(f).column] == Part.OBJECT for k, f in enumerate(frames)]
    assert np.mean([k.mean() for k in kept]) > 0.98


# Connected parts: what belongs to the object although a gap separates it, and what does not.


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
    found = find_object([np.concatenate([BODY, part])] * 2, [TABLE], REGION, SIZE)
    assert found.contain(BODY).all()
    assert found.contain(part).mean() == pytest.approx(float(belongs), abs=0.02)


def test_the_cameras_decide_which_of_two_things_is_the_object():
    """The other one is larger, but beside the common view."""
    other = _block((150, 230), (-40, 40), (1, 60), 1.5)
    found = find_object([np.concatenate([BODY, other])] * 2, [TABLE], REGION, SIZE)
    assert found.contain(BODY).all() and not found.contain(other).any()


def test_stray_points_of_one_frame_are_not_the_object():
    stray = np.random.default_rng(0).uniform(-200, 200, (300, 3))
    frames = [np.concatenate([BODY, stray]), BODY]
    found = find_object(frames, [], REGION, SIZE)
    far = np.abs(stray - [0, 0, 55]).max(1) > 40
    assert found.contain(BODY).all() and not found.contain(stray[far]).any()


def test_without_points_there_is_no_object():
    found = find_object([np.zeros((0, 3))], [], REGION, SIZE)
    assert not found.contain(BODY[:5]).any() and len(found.contain(np.zeros((0, 3)))) == 0


# The outline of the object in a frame.


CAMERA = Device(120, 100, 200.0, 200.0, 60.0, 50.0)


def _frame(stride=1):
    shape = (100 // stride, 120 // stride)
    return DecodedFrame(CAMERA, CAMERA, np.eye(4), np.eye(4), np.full((*shape, 2), np.nan, np.float32),
                        np.ones(shape, bool), stride)  # fmt: skip


def test_a_sparse_disc_is_a_full_disc_and_what_is_behind_the_camera_is_nowhere():
    rng = np.random.default_rng(0)
    angle, r = rng.uniform(0, 2 * np.pi, 3000), 10 * np.sqrt(rng.uniform(0, 1, 3000))
    disc = np.column_stack([r * np.cos(angle), r * np.sin(angle), np.full(3000, -100.0)])
    x, y = np.meshgrid(np.arange(120) + 0.5 - 60, np.arange(100) + 0.5 - 50)
    inside = np.hypot(x, y) < 20  # 10 units at a distance of 100 and a focal length of 200
    found = silhouette(_frame(), np.concatenate([disc, disc * [1, 1, -1]]), 2.0)
    assert (found & ~inside).sum() <= 0.05 * inside.sum() and (~found & inside).sum() <= 0.05 * inside.sum()
    half = silhouette(_frame(2), disc, 2.0)
    assert (half == found[::2, ::2]).mean() > 0.97


def test_without_points_there_is_no_outline():
    assert not silhouette(_frame(), np.zeros((0, 3)), 1.0).any()
    assert not silhouette(_frame(), np.array([[0.0, 0.0, 50.0]]), 1.0).any()
