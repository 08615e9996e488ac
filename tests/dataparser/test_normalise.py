import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.dataparser.dataparser import build_samples, enclosing_sphere, normalisation, upright, without_lonely
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.scan import Scan, read_scan
from tests.dataparser.tiny_scan import RADIUS, TinyScan


def directions(count: int, seed: int) -> ndarray:
    """Unit vectors, uniform over the sphere."""
    v = np.random.default_rng(seed).normal(size=(count, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def normalise(root: Path) -> tuple[Scan, Similarity]:
    scan = read_scan(root)
    return scan, normalisation(scan, build_samples(scan))


def test_the_object_is_inside_the_sphere_of_radius_08(tiny_root: Path) -> None:
    _, S = normalise(tiny_root)
    sphere = RADIUS * directions(2000, 0)
    r = np.linalg.norm(S.points(sphere), axis=1)
    assert 0.6 < r.max() < 1.0  # only the lit half was seen, so the centre is off by part of the radius
    assert S.scale == pytest.approx(0.8 / RADIUS, rel=0.15)


@pytest.mark.parametrize(
    "units, S_world_mm",
    [
        ("m", Similarity(1e-3, np.eye(3), np.zeros(3))),
        ("um", Similarity(1e3, Rotation.from_rotvec([0.3, -2.0, 1.0]).as_matrix(), np.array([5e4, -2e5, 1e5]))),
        ("mm", Similarity(1.0, Rotation.from_rotvec([2.0, 1.0, -0.5]).as_matrix(), np.array([1e3, 2e3, -3e3]))),
    ],
)
def test_unit_and_world_frame_do_not_matter(
    tmp_path: Path, tiny_root: Path, units: str, S_world_mm: Similarity
) -> None:
    reference, S_reference = normalise(tiny_root)
    scan, S = normalise(TinyScan(units=units, S_world_mm=S_world_mm).write(tmp_path / "scan"))
    composed = S @ S_world_mm
    np.testing.assert_allclose(composed.matrix(), S_reference.matrix(), rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        S.poses(scan.poses.T_world_projector), S_reference.poses(reference.poses.T_world_projector), rtol=0, atol=1e-9
    )


def test_the_viewers_up_is_the_cameras_up(tiny_root: Path) -> None:
    # the cameras are around the y axis and look down by 0.3 rad
    scan, S = normalise(tiny_root)
    y_scene = S.R @ [0.0, 1.0, 0.0]
    ups = scan.poses.T_world_camera[:, :3, 1]
    np.testing.assert_allclose(S.R @ ups.mean(0) / np.linalg.norm(ups.mean(0)), [0, 0, 1], atol=1e-12)
    assert y_scene[2] > 0.95
    right = S.poses(scan.poses.T_world_camera)[0, :3, 0]
    assert right[0] > 0.9 and abs(right[1]) < 1e-12


@given(arrays(np.float64, (4, 3), elements=st.floats(-3, 3)), st.integers(1, 4))
def test_upright_is_a_rotation_and_turns_with_the_world(vectors: ndarray, count: int) -> None:
    R = Rotation.from_rotvec(vectors).as_matrix()
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = R[:count]
    axes = upright(T)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) > 0
    turn = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()
    turned = T.copy()
    turned[:, :3, :3] = turn @ T[:, :3, :3]
    assume(abs(np.linalg.norm(T[:, :3, 1].mean(0)) - 0.3) > 1e-9)
    np.testing.assert_allclose(upright(turned) @ turn, axes, atol=1e-9)


def test_cameras_without_a_common_up_use_that_of_the_first() -> None:
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, :3, :3] = np.diag([-1.0, -1.0, 1.0])  # rolled by half a turn
    np.testing.assert_allclose(upright(T), [[1, 0, 0], [0, 0, -1], [0, 1, 0]])


def test_axes_exist_for_a_first_camera_on_its_side() -> None:
    roll = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # its right is the others' up
    T = np.tile(np.eye(4), (4, 1, 1))
    T[0, :3, :3] = roll
    axes = upright(T)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)


def test_one_wrong_pixel_in_ten_changes_little(tmp_path: Path, tiny_root: Path) -> None:
    _, clean = normalise(tiny_root)
    _, noisy = normalise(TinyScan(wrong=0.1).write(tmp_path / "scan"))
    assert noisy.scale == pytest.approx(clean.scale, rel=0.1)
    moved = noisy.points(clean.inverse().points(np.zeros(3)))
    assert np.linalg.norm(moved) < 0.1


def test_enclosing_sphere_of_an_asymmetric_cloud() -> None:
    # a unit sphere and, with most of the points, a unit disc at z = 0.9: the smallest ball around both has its
    # centre at z = c with c + 1 = sqrt(1 + (0.9 - c)^2)
    disc = directions(8000, 2) * [1, 1, 0] + [0, 0, 0.9]
    c = 0.81 / 3.8
    centre, radius = enclosing_sphere(3 * np.concatenate([directions(4000, 1), disc]) + [10, 20, 30])
    np.testing.assert_allclose(centre, [10, 20, 30 + 3 * c], atol=0.05)
    assert 0.97 < radius / (3 * (1 + c)) < 1.01


def test_isolated_points_are_dropped_and_no_others() -> None:
    rng = np.random.default_rng(0)
    plane = np.concatenate([rng.random((3000, 2)), np.zeros((3000, 1))], 1)
    isolated = rng.random((60, 3)) * 20 + [0, 0, 1]
    kept = without_lonely(np.concatenate([plane, isolated]))
    assert (kept[:, 2] == 0).all()
    assert len(kept) > 2980


def test_poses_that_look_away_are_rejected_with_the_likely_cause(tmp_path: Path) -> None:
    root = TinyScan().write(tmp_path / "scan")
    scan = read_scan(root)
    turned = [f.T_world_camera @ np.diag([1.0, -1, -1, 1]) for f in scan.frames]
    scan = dataclasses.replace(
        scan, frames=tuple(dataclasses.replace(f, T_world_camera=T) for f, T in zip(scan.frames, turned, strict=True))
    )
    with pytest.raises(UserError, match=r"only \d+ of \d+ pixels .*OpenCV axes.*sl-check"):
        normalisation(scan, build_samples(scan))
    assert json.loads((root / "transforms.json").read_text())["sl_format"] == 1
