"""Poses, intrinsics, paths and keys, one by one; how poses fit together is in test_check_conventions.py."""

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation
from sphere_scan import CAMERA, NAMES, PROJECTOR, edit, look_up, only_fault, pattern_image

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.scan import PoseSigma, check_scan, read_scan
from sl_nerfstudio.scan.check import coordinate_problems
from sl_nerfstudio.scan.check_images import pattern_shift, shift_problems
from sl_nerfstudio.scan.document import Faults, Fields, Problem, resolve_inside
from sl_nerfstudio.scan.read import pose_problem
from sl_nerfstudio.scan.types import device_problems


def change_pose(root, change, key="transform_matrix", frame=1):
    def apply(document):
        record = document["frames"][frame]
        record[key] = change(np.array(record[key])).tolist()

    edit(root, apply)


def sheared(T):
    T[0, 1] += 0.01
    return T


def times(*axes):
    return lambda T: T @ np.diag([*axes, 1.0])


def last_row(*row):
    return lambda T: np.vstack([T[:3], row])


@pytest.mark.parametrize("key", ["transform_matrix", "projector_transform_matrix"])
@pytest.mark.parametrize(
    ("change", "problem", "words"),
    [
        (times(-1, 1, 1), "is a reflection (the determinant of its rotation is -1)", "left-handed"),
        (times(2, 2, 2), "is scaled: its rotation is 2 times a rotation", "similarity"),
        (times(1, 1, 0), "has no rotation in its upper left 3 x 3 block", "six digits"),
        (sheared, "has no rotation in its upper left 3 x 3 block", "sheared"),
        (lambda T: T * 2, "has the last row 0, 0, 0, 2 instead of 0, 0, 0, 1", "rigid motion"),
        (last_row(0, 0, 1, 0), "has the last row 0, 0, 1, 0 instead of 0, 0, 0, 1", "projective"),
        (lambda T: T.T, "and the last column 0, 0, 0, 1", "transposed"),
        (lambda T: T[:3], "is 3 x 4", "add the row 0, 0, 0, 1"),
        (lambda T: T[:3, :3], "is 3 x 3 instead of 4 x 4", "4 x 4"),
        (lambda T: T.reshape(2, 8), "is 2 x 8 instead of 4 x 4", "4 x 4"),
        (lambda T: T * 1e200, "has the last row", "rigid motion"),
    ],
)
def test_matrices_that_are_no_poses(sphere, key, change, problem, words):
    change_pose(sphere, change, key)
    fault = only_fault(sphere)
    assert (fault.file, fault.frame, fault.field) == ("transforms.json", NAMES[1], key)
    assert problem in fault.problem and words in fault.cause + fault.remedy


def test_five_digits_are_enough(sphere):
    for frame in range(len(NAMES)):
        for key in ("transform_matrix", "projector_transform_matrix"):
            change_pose(sphere, lambda T: np.round(T, 5), key, frame)
    assert check_scan(sphere) == []


def test_projector_in_the_camera_s_place(sphere):
    camera = read_scan(sphere).frames[1].T_world_camera
    change_pose(sphere, lambda T: np.column_stack([T[:, :3], camera[:, 3]]), "projector_transform_matrix")
    fault = check_scan(sphere)[0]
    assert (fault.field, fault.problem) == ("projector_transform_matrix", "has exactly the position of the camera")


def test_all_poses_equal(sphere):
    def equal(document):
        for record in document["frames"]:
            for key in ("transform_matrix", "projector_transform_matrix"):
                record[key] = document["frames"][0][key]

    edit(sphere, equal)
    faults = [f for f in check_scan(sphere) if f.frame is None and f.field == "transform_matrix"]
    assert faults[0].problem == "is the same in all frames, for camera and projector"
    assert "never filled in" in faults[0].cause


@pytest.mark.parametrize(
    ("device", "key", "words"),
    [
        (Device(72, 60, 0.0, 150.0, 36.0, 30.0), "fl_x", "is 0"),
        (Device(72, 60, 150.0, -150.0, 36.0, 30.0), "fl_y", "is -150"),
        (Device(72, 60, 4.2, 150.0, 36.0, 30.0), "fl_x", "is 4.2 pixels, which is impossible"),
        (Device(72, 60, 150.0, 15000.0, 36.0, 30.0), "fl_y", "is 15000 pixels, which is impossible"),
        (Device(72, 60, 150.0, 150.0, 960.0, 30.0), "cx", "is 960, far outside an image of 72 pixels"),
        (Device(72, 60, 150.0, 150.0, 36.0, -540.0), "cy", "is -540, far outside an image of 60 pixels"),
        (Device(72, 60, 60.0, 60.0, 36.0, 30.0, k1=-1.5), "k1", "fold the image over itself"),
        (Device(72, 60, 60.0, 60.0, 36.0, 30.0, p1=3.0), "k1", "fold the image over itself"),
        (Device(100_000, 60_000, 60.0, 60.0, 36.0, 30.0), "w", "is 6000000000 pixels"),
    ],
)
def test_devices_that_cannot_be(device, key, words):
    problems = list(device_problems(device))
    assert [k for k, _ in problems] == [key]
    assert words in "times h " + problems[0][1].problem
    assert problems[0][1].cause and problems[0][1].remedy


@pytest.mark.parametrize(
    "device",
    [
        CAMERA,
        PROJECTOR,
        Device(1920, 1080, 3350.9, 3350.9, 971.0, 1251.0),  # lens shift: principal point below the image
        Device(960, 540, 480.0, 480.0, 480.0, 270.0, k1=-0.25, k2=0.05, p1=1e-3, p2=-1e-3),
        Device(800, 800, 700.0, 700.0, 400.0, 400.0, model="DOE"),
        Device(800, 800, 300.0, 300.0, 400.0, 400.0, model="DOE"),  # corners beyond 90 degrees: unused
    ],
)
def test_devices_that_can(device):
    assert list(device_problems(device)) == []


def test_each_frame_has_intrinsics_of_its_own_or_they_are_common_to_all(sphere):
    edit(sphere, lambda document: [r.update(fl_x=150.0 + i) for i, r in enumerate(document["frames"])])
    faults = check_scan(sphere)
    assert {(fault.frame, fault.field) for fault in faults} == {(name, "fl_x") for name in NAMES[1:]}
    assert faults[0].problem == "is 151.0 here but 150.0 for all frames"
    edit(sphere, lambda document: [document.pop(key) for key in ("fl_x", "k1", "k2", "p1", "p2")])
    assert [frame.camera.fl_x for frame in read_scan(sphere).frames] == [150, 151, 152, 153]

    def own(document):
        common = {key: document.pop(key) for key in ("camera_model", "w", "h", "fl_y", "cx", "cy")}
        for record in document["frames"]:
            record.update(common)

    edit(sphere, own)
    scan = read_scan(sphere)
    assert [frame.camera.fl_x for frame in scan.frames] == [150, 151, 152, 153] and scan.frames[0].camera == CAMERA
    edit(sphere, lambda document: document["frames"][1].pop("cy"))
    fault = only_fault(sphere)
    assert (fault.frame, fault.field, fault.problem) == (NAMES[1], "cy", "is missing")


SIGMA = vars(PoseSigma(3.0, 1.0, 2.0, 0.25))


def test_stated_uncertainty_of_poses(sphere):
    assert read_scan(sphere).frames[0].pose_sigma is None
    edit(sphere, lambda document: document.update(sl_pose_sigma=SIGMA))
    edit(sphere, lambda document: document["frames"][2].update(sl_pose_sigma={**SIGMA, "camera_translation": 9}))
    assert check_scan(sphere) == []
    scan = read_scan(sphere)
    assert scan.frames[0].pose_sigma == PoseSigma(3.0, 1.0, 2.0, 0.25)
    assert scan.frames[2].pose_sigma == PoseSigma(9.0, 1.0, 2.0, 0.25)


@pytest.mark.parametrize("value", [0, -1, 1e308])
def test_an_uncertainty_is_above_zero_and_bounded(sphere, value):
    edit(sphere, lambda document: document["frames"][2].update(sl_pose_sigma={**SIGMA, "relative_rotation_deg": value}))
    fault = only_fault(sphere)
    assert (fault.frame, fault.field) == (NAMES[2], "sl_pose_sigma.relative_rotation_deg")
    assert f"{value}" in fault.problem


rotations = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(x * x for x in q) > 0.01)
positions = st.tuples(*[st.floats(-1e6, 1e6)] * 3)


def pose_of(quaternion, position):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(quaternion).as_matrix(), position
    return T


@given(rotations, positions)
def test_every_rigid_motion_is_a_pose(quaternion, position):
    assert pose_problem(pose_of(quaternion, position)) is None


@given(rotations, positions, st.floats(1e-4, 1e4).filter(lambda s: abs(s - 1) > 1e-3), st.booleans())
def test_no_similarity_and_no_reflection_is_a_pose(quaternion, position, scale, reflected):
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
def test_a_path_is_inside_the_folder_or_refused(text):
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
def test_no_value_of_a_key_is_misread_or_crashes(value):
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
def test_the_shift_of_coordinates_is_measured_in_the_pattern(shift):
    pattern = pattern_image()
    x, y = np.meshgrid(np.linspace(8, PROJECTOR.w - 8, 70), np.linspace(8, PROJECTOR.h - 8, 60))
    true = np.stack([x, y], -1).astype(np.float32)
    captured = look_up(pattern, true).astype(np.float32) / 255
    found = pattern_shift(
        true - np.float32(shift), np.ones(x.shape, dtype=bool), captured, pattern.astype(np.float32) / 255
    )
    assert found is not None
    np.testing.assert_allclose(found, shift, atol=0.12)


def test_half_a_pixel_is_reported_with_its_direction_and_nothing_else():
    half, none = np.array([0.5, 0.5]), np.zeros(2)
    assert [p.remedy for p in shift_problems([half] * 4)] == ["add 0.5 to both coordinates everywhere"]
    assert [p.remedy for p in shift_problems([-half] * 4)] == ["subtract 0.5 from both coordinates everywhere"]
    for shifts in ([none] * 4, [half], [half, half, none, none], [np.array([0.5, 0.0])] * 4, [None] * 4, []):
        assert list(shift_problems(shifts)) == []


@given(st.integers(0, 2**31 - 1), st.floats(0, 0.6))
def test_honest_coordinates_have_no_problem(seed, missing):
    """Any smooth coordinates inside the pattern, with any share of undecoded pixels."""
    rng = np.random.default_rng(seed)
    smooth = gaussian_filter(rng.normal(size=(30, 40, 2)), (4, 4, 0))
    coords = ((smooth - smooth.min((0, 1))) / np.ptp(smooth, (0, 1)) * (PROJECTOR.w, PROJECTOR.h)).astype(np.float32)
    coords[rng.random((30, 40)) < missing] = np.nan
    assert list(coordinate_problems(coords, PROJECTOR)) == []


@pytest.mark.parametrize(
    ("files", "problem", "remedy"),
    [
        (["a.jpg", "b.jpg"], "these are photographs, not a scan", "sl-process --images {} "),
        (["images/a.jpg"], "these are photographs, not a scan", "sl-process --images {}/images "),
        (["p0/a.png", "p1/a.png"], "these are photographs, not a scan", "sl-process --images {} "),
        (["images/p0/a.png"], "these are photographs, not a scan", "sl-process --images {}/images "),
        (["scan/transforms.json"], "there is one in scan", "give {}/scan"),
        (["transforms_train.json", "train/a.png"], "there is transforms_train.json", "sl-process"),
        (["images/a.png", "coords/a.npz"], "is missing in", "sl-process makes one from photographs"),
        ([], "is missing in", "sl-process makes one from photographs"),
    ],
)
def test_a_folder_without_a_scan_is_named_by_what_it_holds(tmp_path, files, problem, remedy):
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    (fault,) = check_scan(tmp_path)
    assert problem in fault.problem and remedy.format(tmp_path) in fault.remedy
