"""A frame's cloud, its surface on a lattice of camera pixels, and the tone of that surface."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project
from sl_nerfstudio.geometry.triangulation import closest_approach, pixel_centres
from sl_nerfstudio.registration import surfaces
from sl_nerfstudio.registration.surfaces import (
    FrameCloud,
    build_surface_map,
    frame_cloud,
    motion_by_pose_errors,
    reliable_points,
    surface_tone,
)
from sl_nerfstudio.relative_pose import epipolar, estimation
from sl_nerfstudio.relative_pose.epipolar import correspondences_of, directions, moved
from sl_nerfstudio.relative_pose.estimation import RelativePoseError, estimate_relative_pose
from tests.bundle_adjustment.analytic import PROJECTORS, camera_of, cast, rig_of, seen
from tests.registration.analytic_clouds import clouds_of
from tests.registration.shaped_clouds import cloud_of_depth, with_wall
from tests.relative_pose.two_views import known_pose

SIZE = 90
RIG = rig_of(2, SIZE)
DEVICES = camera_of(SIZE), PROJECTORS["pinhole"]
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
    pose = known_pose(RIG.T_camera_projector[0].numpy(), *uv, *DEVICES)
    cloud = frame_cloud("a", coords, *DEVICES, pose)
    d_camera, d_projector = (
        torch.from_numpy(directions(device, xy[pose.inliers])) for device, xy in zip(DEVICES, uv, strict=True)
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


def test_of_large_images_points_are_on_a_lattice_and_coordinates_are_judged_everywhere(monkeypatch):
    step, rng = 3, np.random.default_rng(0)
    coords = _image(0) + rng.normal(0, 0.1, (SIZE, SIZE, 2)).astype(np.float32)
    decoded = np.argwhere(np.isfinite(coords).all(-1))
    wrong = decoded[rng.random(len(decoded)) < 0.1]
    coords[wrong[:, 0], wrong[:, 1]] += np.float32([30, -25])
    coords[decoded[5][0], decoded[5][1], 1] = np.nan
    every = estimate_relative_pose(*correspondences_of(coords), *DEVICES)
    whole = frame_cloud("a", coords, *DEVICES, every)
    for module in (epipolar, estimation):
        monkeypatch.setattr(module, "lattice_step", lambda h, w: step)
    uv = correspondences_of(coords)
    assert (np.floor(uv[0]) % step == 0).all() and len(uv[0]) == np.isfinite(coords[::step, ::step]).all(-1).sum()
    thin = frame_cloud("a", coords, *DEVICES, estimate_relative_pose(*uv, *DEVICES))
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


def test_a_frame_with_too_few_points_is_refused_by_name():
    pose = estimate_relative_pose(*correspondences_of(_image(0)), *DEVICES)
    few = replace(pose, inliers=pose.inliers & (np.cumsum(pose.inliers) < surfaces.FEWEST_POINTS))
    with pytest.raises(RelativePoseError, match=r"photo_7: only 49 points agree(.|\n)*remedy"):
        frame_cloud("photo_7", _image(0), *DEVICES, few)
    enough = replace(pose, inliers=pose.inliers & (np.cumsum(pose.inliers) <= surfaces.FEWEST_POINTS))
    assert len(frame_cloud("photo_7", _image(0), *DEVICES, enough).points) == surfaces.FEWEST_POINTS


def _image(k: int) -> np.ndarray:
    uv = pixel_centres(camera_of(SIZE), torch.float64).reshape(-1, 2)
    return seen(RIG, torch.full((len(uv),), k), uv)[0].reshape(SIZE, SIZE, 2).float().numpy().copy()


# The lattice.

CAMERAS = {
    "pinhole": Device(120, 90, 150.0, 152.0, 61.0, 44.0),
    "lens": Device(120, 90, 150.0, 152.0, 61.0, 44.0, k1=-0.2, k2=0.05, p1=2e-3, p2=-3e-3),
}
NORMAL = np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0])
DISTANCE = 3.0  # of the plane from the camera


def plane_cloud(camera: Device, step: float = 0.0) -> FrameCloud:
    """A plane that fills the image; `step` moves its right half away."""
    column, row = np.meshgrid(np.arange(camera.w) + 0.5, np.arange(camera.h) + 0.5)
    uv = np.stack([column, row], -1).reshape(-1, 2)
    ray = directions(camera, uv)
    depth = -DISTANCE / (ray @ NORMAL) * (1 + np.where(uv[:, 0] > camera.w / 2, step, 0.0))
    even = np.full(len(uv), 1e-3)
    parts = {"points": ray * depth[:, None], "sigma_noise": even, "pose_errors": np.outer(even, np.eye(5)[0])}
    return replace(clouds_of(RIG, SIZE)[0], camera=camera, uv_camera=uv, **parts)


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_plane_keeps_its_place_and_its_normal_whatever_the_lens(camera):
    found = build_surface_map(plane_cloud(CAMERAS[camera]))
    inner = found.valid[5:-5, 5:-5]
    assert inner.all()
    np.testing.assert_allclose(found.point[found.valid] @ NORMAL, -DISTANCE, rtol=1e-4)
    # The slope of the distortion itself is neglected: up to four degrees in the corners of this lens.
    least = 0.999999 if camera == "pinhole" else np.cos(np.radians(4))
    assert (found.normal[found.valid] @ NORMAL).min() > least


def test_points_of_the_map_project_into_their_pixels(monkeypatch):
    monkeypatch.setattr(surfaces, "LARGEST_SIDE", 60)
    found = build_surface_map(plane_cloud(CAMERAS["lens"]))
    assert found.valid.shape == (45, 60)
    assert (found.camera.w, found.camera.h) == (60, 45)
    uv, front = project(Intrinsics.of(found.camera, torch.float64), torch.from_numpy(found.point[found.valid]))
    row, column = np.nonzero(found.valid)
    assert front.all()
    np.testing.assert_allclose(uv.numpy(), np.stack([column, row], -1) + 0.5, atol=1e-8)


def test_an_edge_is_left_out_and_a_small_step_is_not():
    camera = CAMERAS["pinhole"]
    torn, smooth = (build_surface_map(plane_cloud(camera, step=s)).valid for s in (0.3, 0.01))
    middle = slice(camera.w // 2 - 1, camera.w // 2 + 1)
    assert not torn[10:-10, middle].any()
    assert torn[10:-10, : camera.w // 2 - 3].all()
    assert smooth[10:-10].all()


def test_sparse_places_and_steep_surfaces_are_left_out(monkeypatch):
    cloud = plane_cloud(CAMERAS["pinhole"])
    keep = (np.floor(cloud.uv_camera).astype(int) % 4 == 0).all(1)  # one in sixteen: two in a window at most
    parts = {k: getattr(cloud, k)[keep] for k in ("uv_camera", "points", "sigma_noise", "pose_errors")}
    assert not build_surface_map(replace(cloud, **parts)).valid.any()
    monkeypatch.setattr(surfaces, "FEWEST_PIXELS", 3)
    monkeypatch.setattr(surfaces, "HALF_WINDOW", 4)
    assert build_surface_map(replace(cloud, **parts)).valid.any()
    monkeypatch.setattr(surfaces, "LEAST_COSINE", 0.99)
    found = build_surface_map(cloud)
    cosine = -(found.normal * found.point).sum(-1) / np.linalg.norm(found.point, axis=-1).clip(1e-12)
    assert found.valid.any() and not found.valid.all() and (cosine[found.valid] > 0.99).all()


def test_orientations_that_are_rare_get_their_share_of_the_samples():
    """One over the square root of their number each: a steep strip of a tenth counts as a quarter, not as a tenth."""
    found = build_surface_map(cloud_of_depth(lambda x, y: 3 + np.where(x > 0.3, 2.0 * (x - 0.3), 0.0), 120))
    steep = found.normal[found.valid][:, 2] < np.cos(np.radians(25))
    share = steep.mean()
    assert 0.05 < share < 0.15
    expected = np.sqrt(share) / (np.sqrt(share) + np.sqrt(1 - share))
    _, normals, _ = found.sample(2000, np.random.default_rng(0))
    drawn = (normals[:, 2] < np.cos(np.radians(25))).mean()
    assert drawn == pytest.approx(expected, abs=0.1)
    assert drawn > 1.8 * share


def test_the_uncertainty_of_a_surface_is_that_of_its_points_along_the_normal():
    """With a part that no averaging removes: a share of a map pixel."""
    cloud = cloud_of_depth(lambda x, y: 3 + 0.5 * x, 100, sigma=0.02)
    found = build_surface_map(replace(cloud, pose_errors=np.zeros_like(cloud.pose_errors)))
    p, n = found.point[found.valid], found.normal[found.valid]
    distance = np.linalg.norm(p, axis=1)
    lattice = surfaces.LATTICE_ERROR * distance / found.camera.fl_x
    expected = np.hypot(cloud.sigma_noise[0] * -(n * p).sum(1) / distance, lattice)
    np.testing.assert_allclose(found.sigma[found.valid], expected, rtol=1e-6)


def test_errors_that_move_turn_or_scale_the_whole_surface_do_not_make_it_uncertain():
    """Registration finds that similarity; what bends the surface remains."""
    cloud = cloud_of_depth(lambda x, y: 3 + 0.2 * np.sin(4 * x) * np.cos(5 * y), 100, sigma=0.01)
    distance = np.linalg.norm(cloud.points, axis=1)
    x = cloud.points[:, 0] / distance
    errors = np.zeros((5, len(distance), 5))
    errors[1, :, 2] = 0.1 * distance  # the scale, about the camera
    errors[2, :, 3] = 0.1 * np.sign(np.sin(40 * x))
    alone, scaled, bent = (build_surface_map(replace(cloud, pose_errors=e)) for e in errors[:3])
    np.testing.assert_allclose(scaled.sigma[alone.valid], alone.sigma[alone.valid], rtol=0.05)
    assert np.median((bent.sigma / alone.sigma)[bent.valid]) > 10


def test_a_wall_behind_the_object_moves_all_that_is_seen_but_not_its_middle():
    cloud = clouds_of(rig_of(18, 100), 100)[0]
    alone, walled = (build_surface_map(c) for c in (cloud, with_wall(cloud, 8 * np.linalg.norm(cloud.centroid))))
    assert walled.radius > 3 * alone.radius
    assert np.linalg.norm(walled.views[0].centre - alone.views[0].centre) > alone.radius
    assert np.linalg.norm(walled.views[1].centre - alone.views[1].centre) < 0.3 * alone.radius
    assert walled.views[1].size == pytest.approx(alone.views[1].size, rel=0.05)


# Tone.

TONE_SIZE = 120
EYE = np.array([0.0, 0.0, 4.0])  # the ball's centre is the origin; axes as the camera's


def ball() -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of a ball of radius one, NaN beside it; camera axes."""
    x, y = np.meshgrid(np.linspace(-1.1, 1.1, TONE_SIZE), np.linspace(1.1, -1.1, TONE_SIZE))
    with np.errstate(invalid="ignore"):
        normal = np.stack([x, y, np.sqrt(1 - x**2 - y**2)], -1)
    normal[~np.isfinite(normal[..., 2])] = np.nan
    return normal - EYE, normal


def texture(p: np.ndarray) -> np.ndarray:
    return np.exp(0.2 * np.cos(24 * p[..., 0]) * np.cos(21 * p[..., 1] + 2) * np.cos(9 * p[..., 2]))


def returned(albedo: np.ndarray, projector: np.ndarray, gloss: float = 0.0) -> np.ndarray:
    """Light of a matte ball with a highlight (Blinn and Phong)."""
    point, normal = ball()
    ray = projector - point
    distance = np.linalg.norm(ray, axis=-1, keepdims=True)
    half = ray / distance - point / np.linalg.norm(point, axis=-1, keepdims=True)
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    matte = albedo * (normal * ray / distance).sum(-1)
    return (matte + gloss * (normal * half).sum(-1).clip(0) ** 40) / distance[..., 0] ** 2


def tone(light: np.ndarray, projector: np.ndarray) -> np.ndarray:
    point, normal = (np.nan_to_num(part) for part in ball())
    return surface_tone(light, point, normal, projector)


LEFT, RIGHT = np.array([-1.5, 0.5, 0.0]), np.array([1.2, -0.3, -0.5])


def alike(a: np.ndarray, b: np.ndarray) -> float:
    both = np.isfinite(a) & np.isfinite(b)
    assert both.sum() > 1000
    return float(np.corrcoef(a[both], b[both])[0, 1])


@pytest.mark.parametrize("gloss", [0.0, 0.5])
def test_the_tone_is_that_of_the_texture_wherever_the_light_comes_from(gloss):
    albedo = texture(ball()[1])
    found = [tone(returned(albedo, at, gloss), at) for at in (LEFT, RIGHT)]
    assert alike(*found) > (0.93 if gloss == 0 else 0.75)
    assert alike(found[0], np.log(albedo)) > 0.9


def test_exposure_and_unit_do_not_matter():
    light = returned(texture(ball()[1]), LEFT)
    once = tone(light, LEFT)
    np.testing.assert_allclose(tone(7 * light, LEFT), once, atol=1e-5)
    point, normal = (np.nan_to_num(part) for part in ball())
    np.testing.assert_allclose(surface_tone(light, 1e3 * point, normal, 1e3 * LEFT), once, atol=1e-5)


def test_what_is_dark_oblique_or_small_has_no_tone():
    light = returned(texture(ball()[1]), RIGHT)
    found = tone(light, RIGHT)
    point, normal = ball()
    with np.errstate(invalid="ignore"):
        oblique = (normal * (RIGHT - point)).sum(-1) / np.linalg.norm(RIGHT - point, axis=-1) < surfaces.TONE_COSINE
    assert np.isnan(found[oblique]).all() and np.isfinite(found).sum() > 3000
    light[:, :60] = 0.0  # shadow
    light[70, 90] = np.nan
    found = tone(light, RIGHT)
    assert np.isnan(found[:, :60]).all() and np.isnan(found[70, 90]) and np.isfinite(found[76, 84])
    light[5:, 60:] = np.nan
    assert np.isnan(tone(light, RIGHT)).all()


def test_a_highlight_is_not_a_tone():
    """A surface without texture, under light and gloss, is nearly even."""
    even, textured = (tone(returned(a, LEFT, 0.5), LEFT) for a in (np.ones((TONE_SIZE, TONE_SIZE)), texture(ball()[1])))
    assert np.nanstd(even) < 0.1 * np.nanstd(textured)


def test_unreliable_points_are_left_out_of_surfaces():
    cloud = clouds_of(RIG, SIZE, noise=0.1)[0]
    sigma = cloud.sigma_noise.copy()
    sigma[:25] *= 100
    good = reliable_points(replace(cloud, sigma_noise=sigma))
    assert not good[:25].any() and good.mean() > 0.9
