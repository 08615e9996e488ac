"""What registration found, and the known length that sets its scale."""

import numpy as np
import pytest

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.registration.result import (
    KnownLength,
    NoCommonSurface,
    Registration,
    UncertainRotation,
    UndecidedProjector,
    parse_known_length,
    scale_to,
    without_undecided,
)
from tests.bundle_adjustment.analytic import rig_of
from tests.registration.analytic_clouds import clouds_of

SIZE = 60
RIG = rig_of(3, SIZE)


@pytest.fixture(scope="module")
def clouds():
    return clouds_of(RIG, SIZE)


def shrunk(factor: float):
    """Poses of the scene at another size."""
    out = []
    for T in (RIG.T_world_camera.numpy().copy(), RIG.T_world_projector.numpy().copy()):
        T[:, :3, 3] *= factor
        out.append(T)
    return out


@pytest.mark.parametrize(
    ("text", "known"),
    [
        ("baseline of frame 0 = 85 mm", KnownLength(0.085, "mm", ("0",))),
        ("baseline  of frame frame_00003=8.5e0cm", KnownLength(0.085, "cm", ("frame_00003",))),
        ("baseline of frame pose 1 = 2 in", KnownLength(0.0508, "mm", ("pose 1",))),  # scans have metric units
        ("baseline of frame 0 = 0.5 Inch", KnownLength(0.0127, "mm", ("0",))),
        (
            "distance from frame pose 1 (1, 2) to frame b(3, 4) = .5 m",
            KnownLength(0.5, "m", ("pose 1", "b"), ((1.0, 2.0), (3.0, 4.0))),
        ),
        (
            "distance between frame 3 (410.5, 200) and frame 7 (35,80.25) = 50 mm",
            KnownLength(0.05, "mm", ("3", "7"), ((410.5, 200.0), (35.0, 80.25))),
        ),
    ],
)
def test_lengths_are_understood(text, known):
    found = parse_known_length(text)
    assert found.metres == pytest.approx(known.metres)
    assert (found.unit, found.frames, found.pixels) == (known.unit, known.frames, known.pixels)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("85 mm", 'not understood(.|\n)*remedy: write "baseline of frame 0 = 85 mm"'),
        ("baseline of frame 0 = 85", "85 has no unit(.|\n)*as 85 mm; units are m, cm, mm, um, in, inch"),
        ("baseline of frame 0 = 1e3", "1e3 has no unit"),
        ("distance between frame 3 (1, 2) and frame 7 (3, 4) = 50", "50 has no unit"),
        ("baseline of frame 0 = 85 feet", 'unit "feet" is none of m, cm, mm, um, in, inch'),
        ("baseline of frame 0 = 8,5 mm", '"8,5 mm" is no length(.|\n)*a comma in place of the decimal point'),
        ("baseline of frame 0 = mm", '"mm" is no length'),
        ("baseline of frame 0 = -85 mm", "a length must be above zero"),
        ("baseline of frame 0 = 0 mm", "a length must be above zero"),
        ("baseline of frame 0 = 1e-400 mm", "a length must be above zero"),
        ("baseline of frame 0 = 1e-320 mm", r"a length must be from 1e-06 to 1e\+12 mm"),
        ("baseline of frame 0 = 1e400 mm", r"a length must be from 1e-06 to 1e\+12 mm"),
        ("baseline of frame 0 = nan mm", '"nan mm" is no length'),
        ("distance between frame 3 and frame 7 = 50 mm", "not understood"),
    ],
)
def test_what_is_not_understood_is_said(text, message):
    with pytest.raises(UserError, match=message):
        parse_known_length(text)


@pytest.mark.parametrize("frame", ["1", "frame_00001"])
def test_a_baseline_sets_the_scale(clouds, frame):
    true = float(RIG.T_camera_projector[1, :3, 3].norm())  # taken for metres
    known = parse_known_length(f"baseline of frame {frame} = {true} m")
    assert scale_to(known, "m", clouds, *shrunk(0.01)) == pytest.approx(100)
    assert scale_to(known, "mm", clouds, *shrunk(0.01)) == pytest.approx(1e5)
    assert known.source == f"baseline of frame {frame}"


def test_a_distance_between_picked_pixels_sets_the_scale(clouds):
    ends, pixels = [], []
    for k in (0, 2):
        n = len(clouds[k].points) // 2
        pixels.append(clouds[k].uv_camera[n])
        T = RIG.T_world_camera[k].numpy()
        length = float(RIG.T_camera_projector[k, :3, 3].norm())
        ends.append(T[:3, :3] @ (length * clouds[k].points[n]) + T[:3, 3])
    true = np.linalg.norm(ends[0] - ends[1])
    (x1, y1), (x2, y2) = pixels
    text = f"distance from frame 0 ({x1}, {y1}) to frame 2 ({x2}, {y2}) = {1000 * true} mm"
    assert scale_to(parse_known_length(text), "m", clouds, *shrunk(0.5)) == pytest.approx(2, rel=0.02)


def test_frames_and_pixels_that_are_not_there_are_named(clouds):
    camera, projector = shrunk(1.0)
    with pytest.raises(UserError, match=r'no frame "7"(.|\n)*0 to 2'):
        scale_to(parse_known_length("baseline of frame 7 = 1 m"), "m", clouds, camera, projector)
    with pytest.raises(UserError, match=r"frame_00000: nothing was decoded within 3 pixels of \(1, 1\)"):
        scale_to(
            parse_known_length("distance from frame 0 (1, 1) to frame 2 (30, 30) = 1 m"), "m", clouds, camera, projector
        )
    camera[1] = np.nan
    with pytest.raises(UserError, match="frame_00001 was not registered"):
        scale_to(parse_known_length("baseline of frame 1 = 1 m"), "m", clouds, camera, projector)


def test_frames_whose_projector_is_undecided_are_left_out():
    T, baseline, lost = np.tile(np.eye(4), (4, 1, 1)), np.ones(4), (NoCommonSurface("d"),)
    doubtful = tuple(UncertainRotation(name, 5.0) for name in "ab")
    found = Registration(
        tuple("abcd"), T, baseline, np.arange(4) < 3, np.array([0, 0, 0, -1]), np.ones(4), (), lost, doubtful
    )
    doubts = UndecidedProjector("b", 12.0), UndecidedProjector("d", 12.0)  # d is out already
    one = without_undecided(found, doubts)
    assert one.exclusions == (*lost, doubts[0]) and one.uncertainties == doubtful[:1]
    assert one.registered.tolist() == [True, False, True, False] and one.component.tolist() == [0, -1, 0, -1]
    for values in (one.T_world_camera[:, 0, 0], one.baseline, one.fitness):
        assert np.isnan(values).tolist() == [False, True, False, False]
    same = without_undecided(found, ())
    assert same.exclusions == lost and same.registered.tolist() == found.registered.tolist()
