"""Uncertainty of vertices: derivatives, exact motions, a surface that is fitted again, noise by formula."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.covariance import JointCovariance
from sl_nerfstudio.geometry.devices import Device, Intrinsics, project, unproject
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity, exp_se3, inverse, rotate, transform
from sl_nerfstudio.meshing.mesh import Mesh, VertexQuality
from sl_nerfstudio.meshing.uncertainty import (
    AVERAGED_CELLS,
    FrameDevices,
    FrameViews,
    VertexSums,
    all_devices,
    devices_of,
    independent_variance,
    packed_devices,
    point_equations,
    smoothing,
    sum_views,
    surface_rows,
    vertex_uncertainty,
    view_surface,
    views_by_frame,
)
from sl_nerfstudio.meshing.visibility import VIEW, derive_residual, view_point
from sl_nerfstudio.scan import Scan
from tests.bundle_adjustment.analytic import look_at

from .ray_cast_scan import pairs_around, scan_of
from .solids import plate, together

CAMERA = Device(300, 300, 410.0, 400.0, 148.0, 152.0, k1=-0.1, p1=0.002)
LIGHTS = (
    Device(400, 400, 520.0, 530.0, 200.0, 195.0, k1=0.05),
    Device(400, 400, 560.0, 560.0, 200.0, 200.0, model="DOE"),
)
STEP = 1e-5


def frame_of(light: Device) -> FrameDevices:
    camera, projector = look_at((0.4, -0.3, 3.0)), look_at((1.2, 0.5, 2.8))
    return FrameDevices(
        Intrinsics.of(CAMERA, torch.float64), Intrinsics.of(light, torch.float64), camera, inverse(camera) @ projector
    )


def surface() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(3)
    p = 0.6 * torch.rand(40, 3, generator=generator, dtype=torch.float64) - 0.3
    normal = torch.randn(40, 3, generator=generator, dtype=torch.float64) * 0.3
    return p, torch.nn.functional.normalize(normal + torch.tensor([0.3, 0.0, 1.0]), dim=-1)


def changed(d: FrameDevices, by: Tensor) -> FrameDevices:
    """Poses moved by (delta, rho); focal length and principal point of both devices by shares of the focal length."""
    out = []
    for devices, share in ((d.camera, by[12:15]), (d.projector, by[15:18])):
        params, focal = devices.params.clone(), devices.params[:2].clone()
        params[:2] = focal * (1 + share[0])
        params[2:4] = params[2:4] + focal[0] * share[1:]
        out.append(replace(devices, params=params))
    return FrameDevices(out[0], out[1], exp_se3(by[:6]) @ d.T_world_camera, exp_se3(by[6:12]) @ d.T_camera_projector)


def on_plane(d: FrameDevices, uv: Tensor, p: Tensor, normal: Tensor) -> Tensor:
    """Projector pixels of the planes through `p` where the rays of camera pixels meet them."""
    eye, ray = d.T_world_camera[:3, 3], rotate(d.T_world_camera, unproject(d.camera, uv))
    distance = ((p - eye) * normal).sum(-1, keepdim=True) / (ray * normal).sum(-1, keepdim=True)
    T = inverse(d.T_world_camera @ d.T_camera_projector)
    return project(d.projector, transform(T, eye + distance * ray))[0]


def numeric(f: Callable[[Tensor], Tensor], size: int) -> Tensor:
    """Derivatives of a function of `size` numbers at zero, in the last dimension, from differences."""
    steps = STEP * torch.eye(size, dtype=torch.float64)
    return torch.stack([(f(step) - f(-step)) / (2 * STEP) for step in steps], -1)


def derivatives(d: FrameDevices, p: Tensor, normal: Tensor) -> Tensor:
    """Derivatives of the residuals by (delta, rho, intrinsics), from the compiled loop's function."""
    devices, view, out = packed_devices(d), np.empty(VIEW), np.empty((len(p), 2, 18))
    for point, across, by in zip(p.numpy(), normal.numpy(), out, strict=True):
        view_point(devices, point, across, view)
        derive_residual(devices, point, across, view, by)
    return torch.from_numpy(out)


@pytest.mark.parametrize("light", LIGHTS, ids=("pinhole", "DOE"))
def test_the_prediction_of_a_pixel_changes_as_rays_and_planes_do(light):
    d, (p, normal) = frame_of(light), surface()
    view = view_surface(d, p.numpy(), normal.numpy())
    uv = torch.from_numpy(view.uv_camera)
    np.testing.assert_allclose(view.uv_projector, on_plane(d, uv, p, normal), rtol=0, atol=1e-9)
    by_motion = numeric(lambda s: on_plane(d, uv, p + s * normal, normal), 1)
    np.testing.assert_allclose(view.slope, by_motion[..., 0], rtol=1e-6, atol=1e-5)
    by_pixel = numeric(lambda step: on_plane(d, uv + step, p, normal), 2)
    np.testing.assert_allclose(view.by_pixel, by_pixel, rtol=1e-6, atol=1e-5)
    by_devices = numeric(lambda step: on_plane(changed(d, step), uv, p, normal), 18)
    assert torch.allclose(derivatives(d, p, normal), by_devices, rtol=2e-5, atol=2e-4)


def test_pixels_on_an_area_are_those_of_its_projected_corners():
    d, (p, normal) = frame_of(LIGHTS[0]), surface()
    view = view_surface(d, p.numpy(), normal.numpy())
    side = 1e-4
    a = torch.nn.functional.normalize(torch.linalg.cross(normal, torch.ones_like(normal)), dim=-1)
    b = torch.linalg.cross(normal, a)
    T = inverse(d.T_world_camera)
    corner, x, y = (project(d.camera, transform(T, q))[0] for q in (p, p + side * a, p + side * b))
    area = torch.linalg.det(torch.stack([x - corner, y - corner], -1)).abs()
    np.testing.assert_allclose(view.pixels_per_area, area / side**2, rtol=1e-3)


def test_a_point_is_seen_where_both_devices_project_it():
    d, (p, _) = frame_of(LIGHTS[0]), surface()
    by_point, by_rest = point_equations(d, p)

    def seen(devices: FrameDevices, q: Tensor) -> Tensor:
        T = inverse(devices.T_world_camera)
        light = inverse(devices.T_camera_projector) @ T
        both = (devices.camera, T), (devices.projector, light)
        return torch.cat([project(device, transform(pose, q))[0] for device, pose in both], -1)

    assert torch.allclose(by_point, numeric(lambda step: seen(d, p + step), 3), rtol=1e-6, atol=1e-5)
    assert torch.allclose(by_rest, numeric(lambda step: seen(changed(d, step), p), 18), rtol=2e-5, atol=2e-4)


FRAMES, NOISE, CELL = 4, 0.4, 2.0


def hill() -> Mesh:
    """A plate of 60 mm with a bump, so that normals differ."""
    flat = plate(30.0, 1.5)
    x, y, z = (flat.vertices + [0.137, 0.071, 0.0]).T  # no vertex lies exactly between pixels
    return Mesh(np.stack([x, y, z + 10 * np.exp(-(x**2 + (y - 5) ** 2) / 300)], 1), flat.faces)


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    generator = np.random.default_rng(0)

    def noisy(_: int, coords: np.ndarray) -> np.ndarray:
        return (coords + generator.normal(0, NOISE, coords.shape)).astype(np.float32)

    root: Path = tmp_path_factory.mktemp("hill") / "scan"
    return scan_of(hill(), pairs_around(FRAMES, 60), root, noisy)


@pytest.fixture(scope="module")
def views(scan: Scan) -> list[FrameViews]:
    return list(views_by_frame(hill(), scan, scan.poses, None, "test"))


@pytest.fixture(scope="module")
def sums(views: list[FrameViews]) -> VertexSums:
    return sum_views(views, len(hill().vertices))


def confirmed_by(views: list[FrameViews], vertices: np.ndarray) -> np.ndarray:
    """Which frames confirm some vertices."""
    return np.stack([np.isin(vertices, view.vertex) for view in views], 1)


def joined(views: list[FrameViews], name: str) -> np.ndarray:
    return np.concatenate([getattr(view, name) for view in views])


def rows_of(scan: Scan, views: list[FrameViews]) -> tuple[np.ndarray, np.ndarray]:
    mesh = hill()
    vertices = np.unique(joined(views, "vertex"))[::7]
    confirmed, devices = confirmed_by(views, vertices), all_devices(scan, scan.poses)
    return vertices, surface_rows(mesh.vertices[vertices], mesh.vertex_normals()[vertices], devices, confirmed)


def test_frames_residuals_and_angles_are_those_that_confirm_a_vertex(scan: Scan, views: list[FrameViews]):
    found, count = vertex_uncertainty(hill(), scan, scan.poses, None, CELL), len(hill().vertices)
    vertex, angle = joined(views, "vertex"), np.full(count, np.nan)
    number = np.bincount(vertex, minlength=count)
    np.fmax.at(angle, vertex, np.degrees(joined(views, "ray_angle")))
    length = np.bincount(vertex, np.linalg.norm(joined(views, "residual"), axis=1), count)
    assert np.array_equal(found.views, number) and np.array_equal(found.sigma, found.sigma_independent, equal_nan=True)
    np.testing.assert_allclose(found.residual[number > 0], (length / np.maximum(number, 1))[number > 0], rtol=1e-12)
    np.testing.assert_allclose(found.ray_angle, angle, rtol=1e-12)


def test_frames_that_confirm_too_little_have_the_noise_of_the_others():
    one = FrameViews(np.array([0, 1]), np.ones((2, 2)), np.ones((2, 2)), np.ones(2), np.ones(2), 0.5, np.nan)
    few = replace(one, vertex=np.array([1, 2]), noise_px=np.nan)
    sums = sum_views([one, few], 4)
    np.testing.assert_allclose(sums.variance, 0.25 * sums.weight)
    assert sums.weight.tolist() == [2, 4, 2, 0] and sums.correlation == 1
    assert np.isnan(sum_views([few], 4).variance[[1, 2]]).all()


def test_random_draws_are_multiplied_with_fewer_digits(scan: Scan, monkeypatch: pytest.MonkeyPatch):
    exact = vertex_uncertainty(hill(), scan, scan.poses, random_joint(), CELL)
    monkeypatch.setattr("sl_nerfstudio.bundle_adjustment.covariance.EXACT_UNKNOWNS", 0)
    found = vertex_uncertainty(hill(), scan, scan.poses, random_joint(), CELL)
    assert not np.array_equal(found.sigma, exact.sigma, equal_nan=True)
    np.testing.assert_allclose(found.sigma, exact.sigma, rtol=1e-4)


def test_sigma_is_what_the_covariance_says_of_the_surface_less_its_motion(scan: Scan, sums: VertexSums):
    """The whole matrix of derivatives at once, and the motion that fits it best."""
    mesh, joint, seen = hill(), random_joint(), np.flatnonzero(sums.number)
    p, n = mesh.vertices[seen], mesh.vertex_normals()[seen]
    rows = surface_rows(p, n, all_devices(scan, scan.poses), sums.confirmed(seen))
    p = p - p.mean(0)
    rigid = np.concatenate([n, np.cross(p, n)], 1)
    rows = rows - rigid @ np.linalg.lstsq(rigid, rows, rcond=None)[0]
    found = vertex_uncertainty(mesh, scan, scan.poses, joint, CELL)
    shared = found.sigma[seen] ** 2 - found.sigma_independent[seen] ** 2
    np.testing.assert_allclose(shared, ((rows @ joint.matrix) * rows).sum(1), rtol=1e-6)


def random_joint() -> JointCovariance:
    size = 12 * FRAMES + 6
    factor = np.random.default_rng(1).normal(size=(size, size)) / size**0.5
    scale = np.r_[np.tile([0.02] * 3 + [1e-4] * 3, 2 * FRAMES), [1e-4] * 6]  # mm and radian
    return JointCovariance(scale[:, None] * factor)


def test_noise_and_its_independence_are_measured_from_the_scan(views: list[FrameViews], sums: VertexSums):
    np.testing.assert_allclose([view.noise_px for view in views], NOISE, rtol=0.1)
    assert 1 <= sums.correlation < 1.4


def moved(scan: Scan, step: np.ndarray) -> DevicePoses:
    """Poses with (delta, rho) of all frames."""
    delta, rho = torch.from_numpy(step[: 12 * FRAMES]).reshape(2, FRAMES, 6)
    camera = exp_se3(delta) @ torch.from_numpy(scan.poses.T_world_camera)
    relative = exp_se3(rho) @ torch.from_numpy(scan.poses.T_camera_projector)
    return DevicePoses(camera.numpy(), (camera @ relative).numpy())


def test_vertices_move_as_surfaces_that_are_fitted_again(scan: Scan, views: list[FrameViews]):
    """With disturbed poses, each vertex is moved along its normal to where its pixels fit best, by iteration."""
    vertices, rows = rows_of(scan, views)
    mesh = hill()
    p, n = (x[vertices] for x in (mesh.vertices, mesh.vertex_normals()))
    seen = confirmed_by(views, vertices).T
    decoded = [view_surface(devices_of(scan, scan.poses, k), p, n) for k in range(FRAMES)]

    def fitted(poses: DevicePoses) -> np.ndarray:
        s = np.zeros(len(p))
        for _ in range(3):
            pull, total = np.zeros((2, len(p)))
            for k in range(FRAMES):
                view = view_surface(devices_of(scan, poses, k), p + s[:, None] * n, n)
                away = decoded[k].uv_camera - view.uv_camera  # the prediction at the pixel that was decoded
                r = view.uv_projector + np.einsum("nij,nj->ni", view.by_pixel, away) - decoded[k].uv_projector
                weight = seen[k] * decoded[k].pixels_per_area
                pull += weight * (view.slope * r).sum(-1)
                total += weight * (view.slope**2).sum(-1)
            s = s - pull / total
        return s

    joint = random_joint().matrix[: 12 * FRAMES, : 12 * FRAMES]
    for draw in np.random.default_rng(3).multivariate_normal(np.zeros(len(joint)), joint, 8):
        found = (fitted(moved(scan, draw)) - fitted(moved(scan, -draw))) / 2
        np.testing.assert_allclose(rows[:, : 12 * FRAMES] @ draw, found, rtol=1e-3, atol=1e-6)  # of about 0.03 mm


def test_independent_part_is_the_noise_of_the_averaged_pixels(views: list[FrameViews], sums: VertexSums):
    mesh, seen = hill(), np.flatnonzero(sums.number)
    on_truth = replace(sums, pull=np.zeros_like(sums.pull), correlation=1.0)
    area = AVERAGED_CELLS * CELL**2
    v = seen[len(seen) // 2]
    weights = [area * view.pixels_per_area * (view.slope**2).sum(1) * (view.vertex == v) for view in views]
    variance = sum(w.sum() * view.noise_px**2 for w, view in zip(weights, views, strict=True))
    expected = variance / sum(w.sum() for w in weights) ** 2
    assert independent_variance(mesh, on_truth, area)[v] == pytest.approx(expected)
    # a surface that lies 0.6 mm beside what the pixels say is that uncertain
    beside = replace(on_truth, pull=0.6 * sums.weight)
    inner = np.abs(mesh.vertices[seen]).max(1) < 20
    np.testing.assert_allclose(np.sqrt(independent_variance(mesh, beside, area)[seen[inner]]), 0.6, rtol=1e-6)


def test_smoothing_averages_over_the_area_that_was_asked_for():
    mesh = plate(30.0, 1.0)
    one = np.zeros(len(mesh.vertices))
    one[len(one) // 2] = 1.0
    spread = smoothing(mesh, 40.0)(one)
    assert spread.sum() == pytest.approx(1)
    assert 1.0 / (spread**2).sum() == pytest.approx(40.0, rel=0.25)  # each vertex stands for 1 mm^2


def test_units_and_axes_of_the_world_do_not_matter(scan: Scan):
    S = Similarity(1e-3, np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]), np.array([0.3, -0.1, 0.2]))
    poses = scan.poses.mapped(S)
    frames = zip(scan.frames, poses.T_world_camera, poses.T_world_projector, strict=True)
    metres = replace(scan, frames=tuple(replace(f, T_world_camera=c, T_world_projector=p) for f, c, p in frames))
    found = vertex_uncertainty(hill(), scan, scan.poses, random_joint(), CELL)
    other = vertex_uncertainty(hill().mapped(S), metres, poses, random_joint().mapped(S), CELL * 1e-3)
    assert np.array_equal(found.views, other.views)
    for name in ("sigma", "sigma_independent"):
        np.testing.assert_allclose(1e3 * getattr(other, name), getattr(found, name), rtol=1e-4, err_msg=name)
    np.testing.assert_allclose(other.residual, found.residual, rtol=1e-5)


def test_vertices_that_no_frame_confirms_are_marked(scan: Scan):
    """The plate goes on where nothing was decoded, and has an underside."""
    x = plate(45.0, 1.5)
    height = 10 * np.exp(-(x.vertices[:, 0] ** 2 + (x.vertices[:, 1] - 5) ** 2) / 300)
    top = Mesh(x.vertices + height[:, None] * [0, 0, 1], x.faces)
    count = len(top.vertices)
    mesh = together(top, Mesh(top.vertices - [0.0, 0.0, 5.0], top.faces[:, ::-1]))
    found: VertexQuality = vertex_uncertainty(mesh, scan, scan.poses, random_joint(), CELL)
    inside = np.abs(top.vertices[:, :2]).max(1)
    assert (found.views[:count][inside < 25] > 0).all() and (found.views[:count][inside > 33] == 0).all()
    assert (found.views[count:] == 0).all()
    for values in (found.sigma, found.sigma_independent, found.residual, found.ray_angle):
        assert np.array_equal(np.isnan(values), found.views == 0)
    seen = found.views > 0
    assert (found.sigma[seen] > found.sigma_independent[seen]).all() and (found.sigma_independent[seen] > 0).all()
    assert np.nanmin(found.ray_angle) > 8 and np.nanmax(found.ray_angle) < 12  # 20 degrees apart, 60 degrees up
