"""A frame's surface on a lattice of camera pixels."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project
from sl_nerfstudio.registration.settings import SurfaceMapSettings
from sl_nerfstudio.registration.surfaces import FrameCloud, build_surface_map
from sl_nerfstudio.relative_pose.epipolar import directions
from tests.bundle_adjustment.analytic import PROJECTORS, rig_of
from tests.registration.analytic_clouds import clouds_of
from tests.registration.shaped_clouds import cloud_of_depth, with_wall

CAMERAS = {
    "pinhole": Device(120, 90, 150.0, 152.0, 61.0, 44.0),
    "lens": Device(120, 90, 150.0, 152.0, 61.0, 44.0, k1=-0.2, k2=0.05, p1=2e-3, p2=-3e-3),
}
NORMAL = np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0])
DISTANCE = 3.0  # of the plane from the camera


@pytest.fixture(scope="module")
def template() -> FrameCloud:
    return clouds_of(rig_of(2, 60), 60)[0]


def plane_cloud(template: FrameCloud, camera: Device, noise: float = 0.0, step: float = 0.0) -> FrameCloud:
    """A plane that fills the image; `step` moves its right half away."""
    column, row = np.meshgrid(np.arange(camera.w) + 0.5, np.arange(camera.h) + 0.5)
    uv = np.stack([column, row], -1).reshape(-1, 2)
    ray = directions(camera, uv)
    depth = -DISTANCE / (ray @ NORMAL) * (1 + np.where(uv[:, 0] > camera.w / 2, step, 0.0))
    depth = depth * (1 + noise * np.random.default_rng(0).standard_normal(len(depth)))
    even = np.full(len(uv), 1e-3)
    errors = np.outer(even, np.eye(5)[0])
    return replace(
        template,
        camera=camera,
        uv_camera=uv,
        points=ray * depth[:, None],
        sigma_noise=even,
        pose_errors=errors,
    )


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_plane_keeps_its_place_and_its_normal_whatever_the_lens(template, camera):
    found = build_surface_map(plane_cloud(template, CAMERAS[camera]))
    inner = found.valid[5:-5, 5:-5]
    assert inner.all()
    np.testing.assert_allclose(found.point[found.valid] @ NORMAL, -DISTANCE, rtol=1e-4)
    # The slope of the distortion itself is neglected: up to four degrees in the corners of this lens.
    least = 0.999999 if camera == "pinhole" else np.cos(np.radians(4))
    assert (found.normal[found.valid] @ NORMAL).min() > least


def test_noise_is_averaged(template):
    found = build_surface_map(plane_cloud(template, CAMERAS["pinhole"], noise=0.002))
    error = found.point[found.valid] @ NORMAL + DISTANCE
    assert np.std(error) < 0.3 * 0.002 * DISTANCE  # of 25 pixels: one fifth, more at the border
    assert (found.normal[found.valid] @ NORMAL).min() > 0.93


def test_points_of_the_map_project_into_their_pixels(template):
    found = build_surface_map(plane_cloud(template, CAMERAS["lens"]), SurfaceMapSettings(largest_side=60))
    assert found.valid.shape == (45, 60)
    assert (found.camera.w, found.camera.h) == (60, 45)
    uv, front = project(Intrinsics.of(found.camera, torch.float64), torch.from_numpy(found.point[found.valid]))
    row, column = np.nonzero(found.valid)
    assert front.all()
    np.testing.assert_allclose(uv.numpy(), np.stack([column, row], -1) + 0.5, atol=1e-8)


def test_an_edge_is_left_out_and_a_small_step_is_not(template):
    camera = CAMERAS["pinhole"]
    torn, smooth = (build_surface_map(plane_cloud(template, camera, step=s)).valid for s in (0.3, 0.01))
    middle = slice(camera.w // 2 - 1, camera.w // 2 + 1)
    assert not torn[10:-10, middle].any()
    assert torn[10:-10, : camera.w // 2 - 3].all()
    assert smooth[10:-10].all()


def test_sparse_places_are_left_out(template):
    cloud = plane_cloud(template, CAMERAS["pinhole"])
    keep = (np.floor(cloud.uv_camera).astype(int) % 4 == 0).all(1)  # one in sixteen: two in a window at most
    parts = {k: getattr(cloud, k)[keep] for k in ("uv_camera", "points", "sigma_noise", "pose_errors")}
    assert not build_surface_map(replace(cloud, **parts)).valid.any()
    settings = SurfaceMapSettings(fewest_pixels=3, half_window=4)
    assert build_surface_map(replace(cloud, **parts), settings).valid.any()


def test_steep_surfaces_are_left_out(template):
    settings = SurfaceMapSettings(least_cosine=0.99)
    found = build_surface_map(plane_cloud(template, CAMERAS["pinhole"]), settings)
    cosine = -(found.normal * found.point).sum(-1) / np.linalg.norm(found.point, axis=-1).clip(1e-12)
    assert found.valid.any()
    assert not found.valid.all()
    assert (cosine[found.valid] > 0.99).all()


def test_size_and_place_of_what_is_seen(template):
    found = build_surface_map(plane_cloud(template, CAMERAS["pinhole"]))
    p = found.point[found.valid]
    np.testing.assert_allclose(found.centroid, p.mean(0))
    assert found.radius == pytest.approx(np.sqrt(p.var(0).sum()))
    whole = found.views[0]
    behind = np.linalg.norm(whole.centre) - np.linalg.norm(found.centroid)
    assert behind == pytest.approx(0.4 * found.radius)
    np.testing.assert_allclose(np.cross(whole.centre, found.centroid), 0, atol=1e-9)
    assert whole.size == found.radius


def test_samples_are_places_of_the_map_spread_over_it(template):
    found = build_surface_map(plane_cloud(template, CAMERAS["pinhole"]))
    points, normals, sigma = found.sample(200, np.random.default_rng(0))
    assert len(points) == len(normals) == len(sigma) == 200
    known = {tuple(p) for p in found.point[found.valid]}
    assert all(tuple(p) in known for p in points)
    counts, _, _ = np.histogram2d(points[:, 0], points[:, 1], bins=3)
    assert counts.min() > 8
    count = int(found.valid.sum())
    everything, _, _ = found.sample(count, np.random.default_rng(0))
    assert len({tuple(p) for p in everything}) == count


def folded(x, y):
    """A plane square to the line of sight, and a narrow strip that is steep."""
    return 3 + np.where(x > 0.3, 2.0 * (x - 0.3), 0.0)


def test_orientations_that_are_rare_get_their_share_of_the_samples():
    """One over the square root of their number each: a strip of a tenth counts as a quarter, not as a tenth."""
    found = build_surface_map(cloud_of_depth(folded, 120))
    steep = found.normal[found.valid][:, 2] < np.cos(np.radians(25))
    share = steep.mean()
    assert 0.05 < share < 0.15
    expected = np.sqrt(share) / (np.sqrt(share) + np.sqrt(1 - share))
    _, normals, _ = found.sample(2000, np.random.default_rng(0))
    drawn = (normals[:, 2] < np.cos(np.radians(25))).mean()
    assert drawn == pytest.approx(expected, abs=0.1)
    assert drawn > 1.8 * share


def test_the_weight_of_equal_orientations_is_the_root_of_their_number():
    found = build_surface_map(cloud_of_depth(lambda x, y: 3 + 0 * x, 60))
    assert len(np.unique(found.weight)) == 1
    assert found.weight.sum() == pytest.approx(np.sqrt(found.valid.sum()))


def test_the_uncertainty_of_a_surface_is_that_of_its_points_along_the_normal():
    """With a part that no averaging removes: a share of a map pixel."""
    cloud = cloud_of_depth(lambda x, y: 3 + 0.5 * x, 100, sigma=0.02)
    found = build_surface_map(replace(cloud, pose_errors=np.zeros_like(cloud.pose_errors)))
    np.testing.assert_allclose(found.sigma[found.valid], _sigma_along_normal(found, cloud.sigma_noise[0]), rtol=1e-6)


def _sigma_along_normal(found, sigma_ray):
    p, n = found.point[found.valid], found.normal[found.valid]
    distance = np.linalg.norm(p, axis=1)
    lattice = SurfaceMapSettings().lattice_error * distance / found.camera.fl_x
    return np.hypot(sigma_ray * -(n * p).sum(1) / distance, lattice)


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


def test_a_map_without_surface_has_no_samples(template):
    found = build_surface_map(plane_cloud(template, CAMERAS["pinhole"]))
    empty = replace(found, valid=np.zeros_like(found.valid), weight=np.zeros(0))
    assert [len(part) for part in empty.sample(10, np.random.default_rng(0))] == [0, 0, 0]


def test_the_projector_does_not_matter(template):
    assert template.projector == PROJECTORS["pinhole"]
    other = replace(template, projector=PROJECTORS["DOE"])
    np.testing.assert_array_equal(build_surface_map(template).point, build_surface_map(other).point)
