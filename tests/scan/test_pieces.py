"""Paths, poses, keys and shifts one by one, for values beyond those that the fault tests name."""

import os
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation
from sphere_scan import PROJECTOR, look_up, pattern_image

from sl_nerfstudio.scan.check import coordinate_problems
from sl_nerfstudio.scan.check_images import pattern_shift, shift_problems
from sl_nerfstudio.scan.document import Faults, Fields, Problem, resolve_inside
from sl_nerfstudio.scan.read import pose_problem

rotations = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(x * x for x in q) > 0.01)
positions = st.tuples(*[st.floats(-1e6, 1e6)] * 3)


def pose_of(quaternion: tuple[float, ...], position: tuple[float, ...]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(quaternion).as_matrix(), position
    return T


@given(rotations, positions)
def test_every_rigid_motion_is_a_pose(quaternion, position) -> None:
    assert pose_problem(pose_of(quaternion, position)) is None


@given(rotations, positions, st.floats(1e-4, 1e4).filter(lambda s: abs(s - 1) > 1e-3), st.booleans())
def test_no_similarity_and_no_reflection_is_a_pose(quaternion, position, scale, reflected) -> None:
    T = pose_of(quaternion, position)
    T[:3, :3] *= -1.0 if reflected else 1.0
    if reflected:
        found = pose_problem(T)
        assert found is not None and found.problem.startswith("is a reflection")
    T[:3, :3] *= scale
    found = pose_problem(T)
    assert found is not None and found.problem.startswith(f"is scaled: its rotation is {scale:.6g} times")
    assert ("reflection" in found.problem) == reflected


names = st.text(st.characters(exclude_categories=()), min_size=1, max_size=12)


@given(st.lists(names, min_size=1, max_size=4).map("/".join))
def test_a_path_is_inside_the_folder_or_refused(text: str) -> None:
    root = Path("/nowhere/a scan")
    found = resolve_inside(root, text)
    if isinstance(found, Problem):
        assert found.problem and found.cause and found.remedy
    else:
        assert os.path.normpath(found).startswith(str(root)) and ".." not in found.parts


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=12,
)


@given(json_values)
def test_no_value_of_a_key_is_misread_or_crashes(value) -> None:
    """Each reader returns what is there, or None with a fault; numbers that are not finite are listed elsewhere."""
    for read, kind in (
        (Fields.read_number, float),
        (Fields.read_count, int),
        (Fields.read_text, str),
        (Fields.read_flag, bool),
        (Fields.read_matrix, np.ndarray),
        (lambda fields, key: fields.read_numbers(key, 2), list),
    ):
        faults = Faults()
        found = read(Fields({"key": value}, faults, "transforms.json"), "key")
        if found is None:
            assert faults.found or not np.all(np.isfinite(np.array(value, dtype=float)))
        else:
            assert isinstance(found, kind) and not faults.found
            if kind in (float, int):
                assert found == value


shifts = st.tuples(st.floats(-0.8, 0.8), st.floats(-0.8, 0.8))


@given(shifts)
def test_the_shift_of_coordinates_is_measured_in_the_pattern(shift) -> None:
    pattern = pattern_image()
    x, y = np.meshgrid(np.linspace(8, PROJECTOR.w - 8, 70), np.linspace(8, PROJECTOR.h - 8, 60))
    true = np.stack([x, y], -1).astype(np.float32)
    captured = look_up(pattern, true).astype(np.float32) / 255
    found = pattern_shift(
        true - np.float32(shift), np.ones(x.shape, dtype=bool), captured, pattern.astype(np.float32) / 255
    )
    assert found is not None
    np.testing.assert_allclose(found, shift, atol=0.12)


def test_half_a_pixel_is_reported_with_its_direction_and_nothing_else() -> None:
    half, none = np.array([0.5, 0.5]), np.zeros(2)
    assert [p.remedy for p in shift_problems([half] * 4)] == ["add 0.5 to both coordinates everywhere"]
    assert [p.remedy for p in shift_problems([-half] * 4)] == ["subtract 0.5 from both coordinates everywhere"]
    for shifts in ([none] * 4, [half], [half, half, none, none], [np.array([0.5, 0.0])] * 4, [None] * 4, []):
        assert list(shift_problems(shifts)) == []


@given(st.integers(0, 2**31 - 1), st.floats(0, 0.6))
def test_honest_coordinates_have_no_problem(seed: int, missing: float) -> None:
    """Any smooth coordinates inside the pattern, with any share of undecoded pixels."""
    rng = np.random.default_rng(seed)
    smooth = gaussian_filter(rng.normal(size=(30, 40, 2)), (4, 4, 0))
    coords = ((smooth - smooth.min((0, 1))) / np.ptp(smooth, (0, 1)) * (PROJECTOR.w, PROJECTOR.h)).astype(np.float32)
    coords[rng.random((30, 40)) < missing] = np.nan
    assert list(coordinate_problems(coords, PROJECTOR)) == []
