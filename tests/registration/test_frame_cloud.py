from dataclasses import replace

import numpy as np
import pytest
import torch

from sl_nerfstudio.geometry.triangulation import closest_approach, pixel_centres
from sl_nerfstudio.registration.surfaces import build_surface_map, frame_cloud, motion_by_pose_errors, reliable_points
from sl_nerfstudio.relative_pose import epipolar, estimation
from sl_nerfstudio.relative_pose.epipolar import correspondences_of, directions, moved
from sl_nerfstudio.relative_pose.estimation import RelativePoseError, estimate_relative_pose
from tests.bundle_adjustment.analytic import PROJECTORS, camera_of, cast, rig_of, seen
from tests.registration.analytic_clouds import clouds_of
from tests.relative_pose.known_pose import known_pose

SIZE = 90
RIG = rig_of(2, SIZE)
LENGTH = RIG.T_camera_projector[:, :3, 3].norm(dim=-1).numpy()


@pytest.mark.parametrize("projector", PROJECTORS)
def test_points_lie_on_the_surface(projector):
    rig = rig_of(2, SIZE, projector)
    cloud = clouds_of(rig, SIZE, projector)[0]
    p = rig.T_world_camera[0, :3, :3].numpy() @ (LENGTH[0] * cloud.points.T)
    p = p.T + rig.T_world_camera[0, :3, 3].numpy()
    o = rig.T_world_camera[0, :3, 3]
    d = rig.T_world_camera.new_tensor(p) - o
    distance = cast(o.expand_as(d), d / d.norm(dim=-1, keepdim=True))[0]
    np.testing.assert_allclose(d.norm(dim=-1).numpy(), distance.numpy(), atol=2e-5)  # coordinates are float32


def test_the_stated_noise_of_points_is_that_of_their_errors():
    clean, noisy = (clouds_of(RIG, SIZE, noise=n)[0] for n in (0.0, 0.3))
    pairs = {tuple(uv): k for k, uv in enumerate(clean.uv_camera)}
    index = [pairs[tuple(uv)] for uv in noisy.uv_camera]
    error = np.linalg.norm(noisy.points, axis=1) - np.linalg.norm(clean.points[index], axis=1)
    assert np.std(error / noisy.sigma_noise) == pytest.approx(1, abs=0.12)


def test_the_pose_s_uncertainty_makes_points_uncertain():
    """Depth is computed again with poses drawn from the covariance."""
    coords = _image(0) + np.random.default_rng(0).normal(0, 0.3, (SIZE, SIZE, 2)).astype(np.float32)
    uv = correspondences_of(coords)
    devices = camera_of(SIZE), PROJECTORS["pinhole"]
    pose = known_pose(RIG.T_camera_projector[0].numpy(), *uv, *devices)
    cloud = frame_cloud("a", coords, *devices, pose)
    d_camera, d_projector = (
        torch.from_numpy(directions(device, xy[pose.inliers])) for device, xy in zip(devices, uv, strict=True)
    )
    rng, depths = np.random.default_rng(1), []
    for _ in range(60):
        R, t = moved(
            pose.T_camera_projector[:3, :3],
            pose.T_camera_projector[:3, 3],
            rng.multivariate_normal(np.zeros(5), pose.covariance),
        )
        depth, _ = closest_approach(
            torch.zeros(3, dtype=torch.float64), d_camera, torch.from_numpy(t), d_projector @ torch.from_numpy(R).T
        )
        depths.append(depth.numpy())
    measured = np.std(depths, axis=0)
    assert np.median(measured / cloud.sigma_pose) == pytest.approx(1, abs=0.25)


def test_an_error_of_the_pose_that_scales_the_surface_is_found_as_that_similarity():
    cloud = clouds_of(rig_of(2, 60), 60)[0]
    errors = np.zeros((len(cloud.points), 5))
    errors[:, 3] = 0.1 * np.linalg.norm(cloud.points, axis=1)  # about the camera
    some = slice(None, None, max(1, len(cloud.points) // 500))
    p = cloud.points[some]
    found = motion_by_pose_errors(replace(cloud, pose_errors=errors))
    np.testing.assert_allclose(np.delete(found, 3, 1), 0, atol=1e-12)
    v, w, growth = found[:3, 3], found[3:6, 3], found[6, 3]
    centred = p - cloud.centroid
    np.testing.assert_allclose(v + np.cross(w, centred) + growth * centred, 0.1 * p, atol=1e-9)
    assert growth == pytest.approx(0.1)


def test_what_contradicts_the_pose_is_left_out_of_points_and_coordinates():
    coords = _image(0)
    decoded = np.argwhere(np.isfinite(coords).all(-1))
    wrong = decoded[::10]
    coords[wrong[:, 0], wrong[:, 1]] += np.float32([30, -25])
    uv = correspondences_of(coords)
    devices = camera_of(SIZE), PROJECTORS["pinhole"]
    cloud = frame_cloud("a", coords, *devices, known_pose(RIG.T_camera_projector[0].numpy(), *uv, *devices))
    assert np.isnan(cloud.coords[wrong[:, 0], wrong[:, 1]]).all()
    assert len(cloud.points) == np.isfinite(cloud.coords).all(-1).sum() == len(decoded) - len(wrong)


@pytest.mark.parametrize("step", [2, 3])
def test_of_large_images_points_are_on_a_lattice_and_coordinates_are_judged_everywhere(monkeypatch, step):
    rng = np.random.default_rng(0)
    coords = _image(0) + rng.normal(0, 0.1, (SIZE, SIZE, 2)).astype(np.float32)
    decoded = np.argwhere(np.isfinite(coords).all(-1))
    wrong = decoded[rng.random(len(decoded)) < 0.1]
    coords[wrong[:, 0], wrong[:, 1]] += np.float32([30, -25])
    coords[decoded[5][0], decoded[5][1], 1] = np.nan
    devices = camera_of(SIZE), PROJECTORS["pinhole"]
    every = estimate_relative_pose(*correspondences_of(coords), *devices)
    whole = frame_cloud("a", coords, *devices, every)
    for module in (epipolar, estimation):
        monkeypatch.setattr(module, "lattice_step", lambda h, w: step)
    uv = correspondences_of(coords)
    assert (np.floor(uv[0]) % step == 0).all() and len(uv[0]) == np.isfinite(coords[::step, ::step]).all(-1).sum()
    thin = frame_cloud("a", coords, *devices, estimate_relative_pose(*uv, *devices))
    assert thin.pose.inliers.sum() == len(thin.points) == len(correspondences_of(thin.coords)[0])
    np.testing.assert_array_equal(correspondences_of(thin.coords)[0], thin.uv_camera)
    assert not np.isfinite(thin.coords[wrong[:, 0], wrong[:, 1]]).any()
    kept, before = (np.isfinite(one.coords).all(-1) for one in (thin, whole))
    assert (kept != before).mean() < 0.002 and before.sum() > 0.85 * len(decoded)
    place = {tuple(at): k for k, at in enumerate(whole.uv_camera.tolist())}
    same = [(k, place[tuple(at)]) for k, at in enumerate(thin.uv_camera.tolist()) if tuple(at) in place]
    a, b = np.array(same).T
    off = np.linalg.norm(thin.points[a], axis=1) - np.linalg.norm(whole.points[b], axis=1)
    assert (np.abs(off) < 4 * np.hypot(thin.sigma_pose[a], whole.sigma_pose[b])).all()


def test_a_frame_without_points_is_refused_by_name():
    uv = correspondences_of(_image(0))
    pose = estimate_relative_pose(*uv, camera_of(SIZE), PROJECTORS["pinhole"])
    none = replace(pose, inliers=np.zeros_like(pose.inliers))
    with pytest.raises(RelativePoseError, match="photo_7: only 0 points agree"):
        frame_cloud("photo_7", _image(0), camera_of(SIZE), PROJECTORS["pinhole"], none)


def test_unreliable_points_are_left_out_of_surfaces():
    cloud = clouds_of(RIG, SIZE, noise=0.1)[0]
    sigma = cloud.sigma_noise.copy()
    sigma[:25] *= 100
    assert not reliable_points(replace(cloud, sigma_noise=sigma))[:25].any()
    assert reliable_points(cloud).mean() > 0.9


def test_normals_of_the_map_are_those_of_the_surface():
    """On the disk they are its axis; everywhere they look at the camera, whatever its lens."""
    cloud = clouds_of(RIG, SIZE)[0]
    found = build_surface_map(cloud)
    R, t = RIG.T_world_camera[0, :3, :3].numpy(), RIG.T_world_camera[0, :3, 3].numpy()
    p = LENGTH[0] * found.point @ R.T + t
    on_disk = found.valid & (np.abs(p[..., 2] + 0.3) < 2e-3)
    assert on_disk.sum() > 300
    np.testing.assert_allclose((found.normal @ R.T)[on_disk].mean(0), [0, 0, 1], atol=5e-3)
    assert ((found.normal * found.point).sum(-1)[found.valid] < 0).all()
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=-1)[found.valid], 1)


def _image(k: int) -> np.ndarray:
    uv = pixel_centres(camera_of(SIZE), torch.float64).reshape(-1, 2)
    return seen(RIG, torch.full((len(uv),), k), uv)[0].reshape(SIZE, SIZE, 2).float().numpy().copy()
