"""Paths around the object, and errors of poses, coordinates and images: of the kind and size asked for."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.devices import (
    CoordinateNoise,
    ExactMatches,
    NoisyCells,
    PoseNoise,
    disturb_coords,
    disturb_image,
    disturb_poses,
    disturb_relative,
    make_devices,
    make_paths,
    pose_sigma,
)
from sl_nerfstudio.synthesis.scenes import cone_and_cylinder
from tests.formulas import pixels

_OBJECT = cone_and_cylinder()


def _paths(kind, seed, frames=22):
    return make_paths(_OBJECT, frames, kind, np.random.default_rng(seed))


def _out(T):
    return T[:, :3, 3] - _OBJECT.centre


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("frames", [22, 57])
def test_a_hand_held_camera_goes_all_around_the_upper_half(seed, frames):
    poses = _paths("hand-held", seed, frames)
    out = _out(poses.T_world_camera)
    distance = np.linalg.norm(out, axis=1)
    assert distance.min() > 4 * 80 and distance.max() < 5 * 80
    elevation = np.degrees(np.arcsin(out[:, 2] / distance))
    assert elevation.min() > 20 and elevation.max() < 70 and np.ptp(elevation) > 15
    azimuth = np.sort(np.degrees(np.arctan2(out[:, 1], out[:, 0])))
    assert np.diff(np.concatenate([azimuth, azimuth[:1] + 360])).max() < 40
    step = np.degrees(np.arccos((out[1:] * out[:-1]).sum(1) / distance[1:] / distance[:-1]))
    assert step.min() > 1 and step.max() < 35


@pytest.mark.parametrize("seed", range(8))
def test_the_projector_is_beside_the_camera_and_never_twice_in_the_same_place(seed):
    poses = _paths("hand-held", seed)
    relative = _relative(poses)
    baseline = np.linalg.norm(relative[:, :3, 3], axis=1)
    assert baseline.min() > 59.9 and baseline.max() < 120.1 and np.ptp(baseline) > 15
    distance = np.linalg.norm(_out(poses.T_world_projector), axis=1)
    assert distance.min() > 4 * 80 and distance.max() < 5 * 80
    for i in range(len(relative)):
        for j in range(i):
            turn = np.degrees(Rotation.from_matrix(relative[i, :3, :3].T @ relative[j, :3, :3]).magnitude())
            assert turn > 0.2 or np.linalg.norm(relative[i, :3, 3] - relative[j, :3, 3]) > 1.0


@pytest.mark.parametrize("kind", ["hand-held", "rigid-rig", "static-projector"])
@pytest.mark.parametrize("seed", range(8))
def test_both_devices_look_at_the_object_and_poses_are_rigid(kind, seed):
    poses = _paths(kind, seed)
    for T in (poses.T_world_camera, poses.T_world_projector):
        np.testing.assert_allclose(np.linalg.det(T[:, :3, :3]), 1, atol=1e-12)
        np.testing.assert_allclose(
            T[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1), np.tile(np.eye(3), (22, 1, 1)), atol=1e-12
        )
        out = _out(T)
        cosine = (T[:, :3, 2] * out).sum(1) / np.linalg.norm(out, axis=1)
        assert cosine.min() > np.cos(np.radians(4))
        assert (out[:, 2] > 0).all()


@pytest.mark.parametrize("seed", range(8))
def test_a_rigid_rig_is_rigid(seed):
    relative = _relative(_paths("rigid-rig", seed))
    np.testing.assert_allclose(relative, np.tile(relative[0], (22, 1, 1)), atol=1e-10)
    assert 60 < np.linalg.norm(relative[0, :3, 3]) < 120


@pytest.mark.parametrize("seed", range(8))
def test_a_static_projector_stands_still_and_the_camera_does_not(seed):
    poses = _paths("static-projector", seed)
    assert (poses.T_world_projector == poses.T_world_projector[0]).all()
    baseline = np.linalg.norm(_relative(poses)[:, :3, 3], axis=1)
    assert baseline.min() > 60 and baseline.max() < 300
    assert np.linalg.norm(np.diff(poses.T_world_camera[:, :3, 3], axis=0), axis=1).min() > 5


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
        ExactMatches(pixels(devices.camera, T_c, p), pixels(devices.projector, T_p, p), p) for T_c, T_p in pairs
    ]


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


@pytest.mark.parametrize("known", [True, False])
def test_auto_calibration_errors_have_the_sizes_asked_for(truth, known):
    """Lengths are not biased; the first is exact if the scale is known."""
    relative = _relative(truth)
    noise = PoseNoise(0.0, 0.0, 0.22, 0.37, 0.02, known)
    out = disturb_relative(relative, noise, np.random.default_rng(3))
    turned = relative[:, :3, :3].transpose(0, 2, 1) @ out[:, :3, :3]
    assert _rms(_angles(turned)) == pytest.approx(0.22, rel=1e-6)
    a, b = relative[:, :3, 3], out[:, :3, 3]
    length_a, length_b = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
    angle = np.degrees(np.arcsin(np.linalg.norm(np.cross(a, b), axis=1) / length_a / length_b))
    assert _rms(angle) == pytest.approx(0.37, rel=1e-3)
    ratio = np.log(length_b / length_a)
    assert (np.abs(ratio[0]) < 1e-12) == known and (np.abs(ratio[1:]) > 1e-5).all()
    free = ratio[known:]
    assert free.mean() == pytest.approx(0.0, abs=1e-12) and _rms(free) == pytest.approx(0.02, rel=1e-9)


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


def test_sigma_has_no_zeros_where_only_registration_errs(scene, truth, rig):
    sigma = pose_sigma(truth, _start(truth, scene, rig, PoseNoise(1.0, 3.0, 0.0, 0.0, 0.0)), scene.centre)
    assert 0 < sigma.relative_translation < 1e-3 and 0 < sigma.relative_rotation_deg < 1e-3
    assert sigma.camera_translation == pytest.approx(3.0 / np.sqrt(3), rel=1e-6)


_CELLS = NoisyCells(period=20.0, x0=10.0, y0=10.0, rows=40, columns=40, w=800, h=800)


@pytest.fixture(scope="module")
def clean():
    """A turned plane under the pattern, seen on a disc."""
    y, x = np.mgrid[:240, :240] + 0.5
    coords = np.stack([60 + 2.4 * x + 0.3 * y, 50 - 0.25 * x + 2.6 * y], -1)
    mask = (x - 120) ** 2 + (y - 110) ** 2 < 100**2
    coords[~mask] = np.nan
    return coords.astype(np.float32), mask


def _disturbed(clean, sigma=0.0, missing=0.0, wrong=0.0, seed=0):
    return disturb_coords(*clean, _CELLS, CoordinateNoise(sigma, missing, wrong), np.random.default_rng(seed))


def _by_cell(clean, flags):
    """Share of flagged pixels in each cell that is seen; cells of the default grid tile the pattern from 0."""
    coords, mask = clean
    cells, index = np.unique(np.floor(coords[mask] / 20).astype(int), axis=0, return_inverse=True)
    return cells, np.bincount(index, flags) / np.bincount(index)


@pytest.mark.parametrize("sigma", [0.05, 0.3, 2.0])
def test_jitter_is_white_and_has_its_standard_deviation(clean, sigma):
    coords, mask = clean
    error = (_disturbed(clean, sigma) - coords)[mask]
    n = len(error)
    assert np.abs(error.std(0) / sigma - 1).max() < 4 / np.sqrt(2 * n)
    assert np.abs(error.mean(0)).max() < 4 * sigma / np.sqrt(n)
    assert abs(np.corrcoef(error.T)[0, 1]) < 4 / np.sqrt(n)
    assert np.abs(np.corrcoef(error[:-1, 0], error[1:, 0])[0, 1]) < 4 / np.sqrt(n)
    assert np.isnan(_disturbed(clean, sigma)[~mask]).all()


@pytest.mark.parametrize("missing", [0.05, 0.15, 0.6])
def test_missing_cells_are_whole_and_as_many_as_asked(clean, missing):
    out = _disturbed(clean, missing=missing)
    coords, mask = clean
    gone = np.isnan(out[mask])
    assert np.array_equal(gone[:, 0], gone[:, 1])
    _, share = _by_cell(clean, gone[:, 0])
    assert set(np.unique(share)) == {0.0, 1.0}
    assert share.sum() == round(missing * len(share))
    assert np.array_equal(out[mask][~gone[:, 0]], coords[mask][~gone[:, 0]])


def test_missing_cells_gather_in_patches(clean):
    cells, share = _by_cell(clean, np.isnan(_disturbed(clean, missing=0.15)[clean[1]][:, 0]))
    gone = np.zeros((42, 42))
    gone[cells[:, 0] + 1, cells[:, 1] + 1] = share
    seen = np.zeros((42, 42))
    seen[cells[:, 0] + 1, cells[:, 1] + 1] = 1
    right = (gone[:-1] * gone[1:]).sum() / (gone[:-1] * seen[1:]).sum()  # of a missing cell's neighbours
    assert right > 1.5 * 0.15


@pytest.mark.parametrize("wrong", [0.02, 0.10])
def test_wrong_cells_are_whole_periods_off_as_many_as_asked_and_inside_the_pattern(clean, wrong):
    coords, mask = clean
    slip = (_disturbed(clean, wrong=wrong) - coords)[mask] / 20
    assert np.abs(slip - np.rint(slip)).max() < 1e-4
    slip = np.rint(slip)
    assert 1 <= np.abs(slip).max() <= 5
    _, share = _by_cell(clean, slip.any(1))
    assert set(np.unique(share)) == {0.0, 1.0}
    assert share.sum() == round(wrong * len(share))
    _, mean_x = _by_cell(clean, slip[:, 0])
    assert np.array_equal(mean_x, np.rint(mean_x)), "all pixels of a cell slip together"
    out = _disturbed(clean, wrong=wrong)[mask]
    assert out.min() >= 0 and out.max() <= 800


def test_no_coordinate_leaves_the_pattern():
    coords = np.zeros((30, 30, 2), np.float32) + np.array([0.1, 799.9], np.float32)
    out = disturb_coords(
        coords, np.ones((30, 30), bool), _CELLS, CoordinateNoise(1.0, 0.0, 0.0), np.random.default_rng(0)
    )
    assert out.min() >= 0 and out.max() <= 800 and out.std(axis=(0, 1)).min() > 0.3


def test_images_have_shot_noise_saturation_and_eight_bits():
    rng = np.random.default_rng(0)
    levels = np.repeat(np.array([0.0, 0.2, 0.8, 3.0], np.float32), 40_000).reshape(4, 40_000)
    image = disturb_image(levels, 0.9, 0.02, rng) / 255
    for values, signal in zip(image[1:3], (0.18, 0.72), strict=True):
        assert values.mean() == pytest.approx(signal, abs=1e-3)
        assert values.std() == pytest.approx(0.02 * np.sqrt(0.15 + 0.85 * signal), rel=0.05)
    assert (image[3] == 1).all()
    assert np.array_equal(disturb_image(levels, 0.9, 0.0, rng)[1], np.full(40_000, round(0.18 * 255)))
