"""A scan with known faults is scored as what it is."""

import json

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from benchmarks.another_renderer.photograph import into_device
from benchmarks.another_renderer.scoring import Similarity, angle_deg, by_cameras, by_points, score
from benchmarks.another_renderer.sets import CaptureSet, lenses, walk

MOTION = Similarity(0.01, Rotation.from_rotvec([0.5, -1.0, 2.0]).as_matrix(), np.array([3.0, 1.0, -2.0]))


@pytest.fixture
def captures(tmp_path):
    """Truth of eight frames: points of a ball of 50 mm, without images."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=50)
    rng = np.random.default_rng(2)
    one = CaptureSet("ball", "none", "clean", 3, frames=8, resolution=60)
    camera, projector = lenses(one, np.zeros((92, 92)), rng)
    (tmp_path / "truth").mkdir()
    ball.export(tmp_path / "truth" / "object.ply")
    devices = {"camera": camera.document(), "projector": projector.document()}
    (tmp_path / "intrinsics.json").write_text(json.dumps(devices))
    views = walk(one, ball, rng)
    for k, view in enumerate(views):
        row, column = np.indices((60, 60))
        rays = camera.directions(np.stack([column, row], -1) + 0.5) @ view.T_camera[:3, :3].T
        eye = view.T_camera[:3, 3]
        along = -(rays @ eye)
        depth = along - np.sqrt(np.where(50**2 - eye @ eye + along**2 > 0, 50**2 - eye @ eye + along**2, np.nan))
        p = eye + depth[..., None] * rays
        np.savez(
            tmp_path / "truth" / f"shot_{k:03d}.npz", T_camera=view.T_camera, T_projector=view.T_projector, p_world=p,
            uv_projector=projector.pixels(into_device(view.T_projector, p)), object_seen=np.isfinite(p[..., 0]),
        )  # fmt: skip
    return tmp_path, views


def written(captures, change):
    """A scan in other axes and another unit, in which `change` of frame and pose was done first."""
    root, views = captures
    scan = root / "scan"
    (scan / "coords").mkdir(parents=True)
    rows = []
    for k, view in enumerate(views):
        T_camera, T_projector = (MOTION.pose(change(k, T)) for T in (view.T_camera, view.T_projector))
        with np.load(root / "truth" / f"shot_{k:03d}.npz") as stored:
            np.savez(scan / "coords" / f"{k}.npz", coords=stored["uv_projector"].astype(np.float32))
        rows.append({
            "file_path": f"images/shot_{k:03d}.png", "sl_coords_path": f"coords/{k}.npz",
            "transform_matrix": T_camera.tolist(), "projector_transform_matrix": T_projector.tolist(),
        })  # fmt: skip
    sigma = {"camera_translation": 0.01, "camera_rotation_deg": 0.1, "relative_translation": 0.01,
             "relative_rotation_deg": 0.1}  # fmt: skip
    (scan / "transforms.json").write_text(json.dumps({"sl_pose_sigma": sigma, "frames": rows}))
    return score(scan, root)


def test_a_perfect_scan_has_no_errors(captures):
    found = written(captures, lambda k, T: T)
    assert len(found.usable) == len(found.errors) == 8
    assert all(e.right and e.camera_deg < 1e-3 and e.camera_deg_by_cameras < 1e-3 for e in found.errors)
    assert found.surface_95 < 2e-3  # of the ball's facets
    assert (found.decoded, found.wrong_pixels) == (1.0, 0.0)


@pytest.mark.parametrize("angle", [4.0, 120.0])
def test_frames_that_are_turned_about_the_object_are_wrong_and_no_others(captures, angle):
    """A turn of camera and projector together: only where the points are tells, and that on a ball."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0, 0, np.radians(angle)]).as_matrix()
    found = written(captures, lambda k, T: turn @ T if k in (2, 5) else T)
    assert [e.name for e in found.errors if not e.right] == ["shot_002", "shot_005"]
    off = {e.name: e for e in found.errors}
    assert off["shot_002"].camera_deg_by_cameras == pytest.approx(angle, abs=0.01)
    assert off["shot_002"].rotation_sigma == pytest.approx(angle / np.sqrt(3) / 0.1, rel=0.01)
    assert off["shot_002"].relative_rotation_sigma == pytest.approx(0, abs=1e-3)
    assert off["shot_000"].translation_sigma < 0.01
    assert off["shot_002"].translation_sigma < 0.01  # it turns about the middle of the object, which stays where it is


def test_a_shift_of_a_frame_is_judged_by_what_is_stated_for_it(captures):
    shift = np.eye(4)
    shift[:3, 3] = (3.0, -2.0, 1.0)
    found = written(captures, lambda k, T: shift @ T if k == 4 else T)
    off = found.errors[4]
    assert off.right and off.rotation_sigma < 0.01
    assert off.translation_sigma == pytest.approx(np.sqrt(14) * MOTION.s / np.sqrt(3) / 0.01, rel=0.01)


def test_alignments_are_not_moved_by_a_third_of_the_frames():
    rng = np.random.default_rng(4)
    true, found, points, moved = [], [], [], []
    for k in range(12):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.random(random_state=k).as_matrix(), rng.normal(size=3) * 100
        p = rng.normal(size=(40, 3)) * 30
        S = (
            Similarity(0.0104, Rotation.random(random_state=90 + k).as_matrix(), rng.normal(size=3))
            if k % 3 == 0
            else MOTION
        )
        true.append(T)
        found.append(S.pose(T))
        points.append(p)
        moved.append(S.points(p))
    for S in (by_cameras(found, true), by_points(moved, points, 5.0)):
        assert S.s == pytest.approx(1 / MOTION.s, rel=1e-3)
        assert angle_deg(S.R @ MOTION.R) < 0.01
        assert S.points(MOTION.points(points[0])) == pytest.approx(points[0], abs=0.05)
