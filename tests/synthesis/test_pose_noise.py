"""Errors of starting poses: their size, their kind, and what is said of them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.devices import (
    ExactMatches,
    PoseNoise,
    disturb_poses,
    disturb_relative,
    make_devices,
    make_paths,
    pose_sigma,
)
from sl_nerfstudio.synthesis.scenes import cone_and_cylinder

_FRAMES = 24


@pytest.fixture(scope="module")
def scene():
    return cone_and_cylinder()


@pytest.fixture(scope="module")
def truth(scene):
    return make_paths(scene, _FRAMES, "hand-held", np.random.default_rng(1))


@pytest.fixture(scope="module")
def rig(scene, truth):
    """Devices, and for each frame matches of points scattered over the object's bounding box."""
    devices = make_devices(scene, truth, (800, 800), SynthConfig())
    rng = np.random.default_rng(2)
    p = scene.centre + rng.uniform(-1, 1, (150, 3)) * np.ptp(scene.vertices, axis=0) / 2
    pairs = zip(truth.T_world_camera, truth.T_world_projector, strict=True)
    return devices, [
        ExactMatches(_pixel(devices.camera, T_c, p), _pixel(devices.projector, T_p, p), p) for T_c, T_p in pairs
    ]


def _pixel(device, T, p):
    q = (p - T[:3, 3]) @ T[:3, :3]
    return np.stack([device.cx - device.fl_x * q[:, 0] / q[:, 2], device.cy + device.fl_y * q[:, 1] / q[:, 2]], 1)


def _start(truth, scene, rig, noise, seed=0):
    return disturb_poses(truth, noise, scene.centre, *rig, np.random.default_rng(seed))


def _relative(poses):
    return np.linalg.inv(poses.T_world_camera) @ poses.T_world_projector


def _angles(R):
    return np.degrees(Rotation.from_matrix(R).magnitude())


def _rms(x):
    return np.sqrt(np.mean(np.square(x)))


def test_registration_moves_a_frame_as_a_whole_about_the_object(scene, truth, rig):
    start = _start(truth, scene, rig, PoseNoise(1.0, 3.0, 0.0, 0.0, 0.0))
    moved = start.T_world_camera @ np.linalg.inv(truth.T_world_camera)
    np.testing.assert_allclose(moved @ truth.T_world_projector, start.T_world_projector, atol=1e-9)
    assert _rms(_angles(moved[:, :3, :3])) == pytest.approx(1.0, rel=1e-6)
    shift = moved[:, :3, :3] @ scene.centre + moved[:, :3, 3] - scene.centre
    assert _rms(np.linalg.norm(shift, axis=1)) == pytest.approx(3.0, rel=1e-6)


def test_auto_calibration_errors_have_the_sizes_asked_for(truth):
    relative = _relative(truth)
    noise = PoseNoise(0.0, 0.0, 0.22, 0.37, 0.02)
    out = disturb_relative(relative, noise, np.random.default_rng(3))
    turned = relative[:, :3, :3].transpose(0, 2, 1) @ out[:, :3, :3]
    assert _rms(_angles(turned)) == pytest.approx(0.22, rel=1e-6)
    a, b = relative[:, :3, 3], out[:, :3, 3]
    length_a, length_b = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
    angle = np.degrees(np.arcsin(np.linalg.norm(np.cross(a, b), axis=1) / length_a / length_b))
    assert _rms(angle) == pytest.approx(0.37, rel=1e-3)
    ratio = np.log(length_b / length_a)
    assert ratio[0] == pytest.approx(0.0, abs=1e-12)
    assert ratio[1:].mean() == pytest.approx(0.0, abs=1e-12), "lengths must not be biased"
    assert _rms(ratio[1:]) == pytest.approx(0.02, rel=1e-9)


def test_without_a_known_scale_all_baselines_err_and_their_geometric_mean_is_right(truth):
    relative = _relative(truth)
    out = disturb_relative(relative, PoseNoise(0.0, 0.0, 0.0, 0.0, 0.05, False), np.random.default_rng(3))
    ratio = np.log(np.linalg.norm(out[:, :3, 3], axis=1) / np.linalg.norm(relative[:, :3, 3], axis=1))
    assert ratio.mean() == pytest.approx(0.0, abs=1e-12) and _rms(ratio) == pytest.approx(0.05)
    assert (np.abs(ratio) > 1e-4).all()


def test_disturbed_rigs_are_put_where_their_points_fit_best(scene, truth, rig):
    """A projector turned by 0.2 deg shifts depth by far more than a millimetre; registration takes that up."""
    noise = PoseNoise(0.0, 0.0, 0.22, 0.37, 0.0)
    start = _start(truth, scene, rig, noise)
    devices, matches = rig
    for n, match in enumerate(matches):
        p = _midpoints(devices, start.T_world_camera[n], start.T_world_projector[n], match)
        kept = _midpoints(devices, truth.T_world_camera[n], truth.T_world_camera[n] @ _relative(start)[n], match)
        error, error_kept = _rms(p - match.p_world), _rms(kept - match.p_world)
        assert error <= error_kept + 1e-9
        np.testing.assert_allclose(p.mean(0), match.p_world.mean(0), atol=1e-6)
    assert _rms(start.T_world_camera[:, :3, 3] - truth.T_world_camera[:, :3, 3]) > 1.0


def _midpoints(devices, T_c, T_p, match):
    """Where the two rays of each match are nearest, by least squares."""
    out = []
    for uv_c, uv_p in zip(match.uv_camera, match.uv_projector, strict=True):
        A, b = np.zeros((3, 3)), np.zeros(3)
        for device, T, uv in ((devices.camera, T_c, uv_c), (devices.projector, T_p, uv_p)):
            d = np.array([(uv[0] - device.cx) / device.fl_x, -(uv[1] - device.cy) / device.fl_y, -1.0])
            d = T[:3, :3] @ (d / np.linalg.norm(d))
            across = np.eye(3) - np.outer(d, d)
            A, b = A + across, b + across @ T[:3, 3]
        out.append(np.linalg.solve(A, b))
    return np.array(out)


def test_poses_stay_rigid_and_follow_the_seed(scene, truth, rig):
    noise = PoseNoise(5.0, 15.0, 0.22, 0.37, 0.02)
    start, again, other = (_start(truth, scene, rig, noise, seed) for seed in (0, 0, 1))
    for T in (start.T_world_camera, start.T_world_projector):
        R = T[:, :3, :3]
        np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-9)
        np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-9)
    assert np.array_equal(start.T_world_camera, again.T_world_camera)
    assert not np.array_equal(start.T_world_camera, other.T_world_camera)


def test_sigma_is_the_error_along_each_axis(scene, truth):
    rng = np.random.default_rng(0)
    n = 1500
    camera = np.repeat(truth.T_world_camera[:1], n, 0)
    projector = np.repeat(truth.T_world_projector[:1], n, 0)
    motion, relative = (np.tile(np.eye(4), (n, 1, 1)) for _ in range(2))
    motion[:, :3, :3] = Rotation.from_rotvec(np.radians(0.7) * rng.standard_normal((n, 3))).as_matrix()
    motion[:, :3, 3] = scene.centre - motion[:, :3, :3] @ scene.centre + 2.0 * rng.standard_normal((n, 3))
    relative[:, :3, :3] = Rotation.from_rotvec(np.radians(0.1) * rng.standard_normal((n, 3))).as_matrix()
    relative[:, :3, 3] = 0.5 * rng.standard_normal((n, 3))
    sigma = pose_sigma(
        DevicePoses(camera, projector), DevicePoses(motion @ camera, motion @ projector @ relative), scene.centre
    )
    assert sigma.camera_translation == pytest.approx(2.0, rel=0.05)
    assert sigma.camera_rotation_deg == pytest.approx(0.7, rel=0.05)
    assert sigma.relative_translation == pytest.approx(0.5, rel=0.05)
    assert sigma.relative_rotation_deg == pytest.approx(0.1, rel=0.05)
