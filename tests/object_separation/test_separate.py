"""The object is kept, and what surrounds it left out, in frames as noisy as real ones."""

from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.object_separation.planes import points_of
from sl_nerfstudio.object_separation.separate import Part, separate

pytestmark = pytest.mark.slow


def _shares(case, found):
    """Shares of the object's and of the surroundings' decoded pixels that are kept."""
    kept = [found.parts(k, frame) == Part.OBJECT for k, frame in enumerate(case.frames)]
    decoded = [np.isfinite(frame.coords).all(-1) for frame in case.frames]
    own = [(k & d & o).sum() / (d & o).sum() for k, d, o in zip(kept, decoded, case.is_object, strict=True)]
    others = sum(int((d & ~o).sum()) for d, o in zip(decoded, case.is_object, strict=True))
    left = sum(int((k & d & ~o).sum()) for k, d, o in zip(kept, decoded, case.is_object, strict=True))
    return np.mean(own), left / max(others, 1)


@pytest.mark.parametrize("background", ["table", "walls", "room", "plate"])
@pytest.mark.parametrize("name", ["box", "medal"])
def test_the_object_stays_and_its_surroundings_go(cases, separated, name, background):
    case, found = cases(name, background), separated(name, background)
    own, left = _shares(case, found)
    assert own > 0.985 and left < 0.01
    assert len(found.surroundings) >= 1


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


def test_the_same_frames_and_seed_give_the_same_answer(cases, separated):
    frames = cases("box", "table").frames
    first, second = separated("box", "table"), separate(frames)
    for k, frame in enumerate(frames):
        np.testing.assert_array_equal(first.parts(k, frame), second.parts(k, frame))


def test_lengths_have_no_say(cases):
    """In metres, and moved and turned as a whole, the answer is the same."""
    case = cases("box", "table")
    c, s = np.cos(0.7), np.sin(0.7)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])

    def moved(T):
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = turn @ T[:3, :3], 0.001 * (turn @ T[:3, 3]) + [5.0, -3.0, 2.0]
        return out

    frames = tuple(
        replace(f, T_world_camera=moved(f.T_world_camera), T_world_projector=moved(f.T_world_projector))
        for f in case.frames
    )
    other = replace(case, frames=frames)
    own, left = _shares(other, separate(frames))
    assert own > 0.985 and left < 0.01


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
