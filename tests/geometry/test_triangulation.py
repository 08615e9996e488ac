"""Triangulation and epipolar residuals of a camera and a projector."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from random_geometry import BATCHES, DEVICES, batches, directions, generator, motions, seeds
from scipy.optimize import minimize_scalar
from torch import Tensor

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project
from sl_nerfstudio.geometry.lie import (
    exp_se3,
    inverse,
    rotate,
    transform,
)
from sl_nerfstudio.geometry.triangulation import (
    OUTLINE,
    beside,
    closest_approach,
    epipolar_residual,
    far_enough,
    frustum,
    triangulate,
)

names = st.sampled_from(sorted(DEVICES))


def rig(source: torch.Generator, baseline: float = 0.4) -> tuple[Tensor, Tensor]:
    """A camera somewhere in the world, and a projector beside it with about the same view."""
    T_world_camera = motions((), source, 1.7)
    xi = torch.tensor([baseline, 0.1 * baseline, 0.05, 0.02, 0.12, -0.05], dtype=torch.float64)
    return T_world_camera, T_world_camera @ exp_se3(xi)


def points(T_world_camera: Tensor, batch: tuple[int, ...], source: torch.Generator) -> Tensor:
    """World points in the view of both."""
    p = torch.rand(*batch, 3, generator=source, dtype=torch.float64) * 0.8 - 0.4
    return transform(T_world_camera, p + torch.tensor([0.15, 0, -3.0], dtype=torch.float64))


def pixels(name: str, T_world_device: Tensor, p_world: Tensor) -> tuple[Intrinsics, Tensor]:
    intrinsics = Intrinsics.of(DEVICES[name], torch.float64)
    uv, in_front = project(intrinsics, transform(inverse(T_world_device), p_world))
    assert bool(in_front.all())
    return intrinsics, uv


@given(seeds, batches, names, names)
def test_exact_correspondences_give_exact_points(
    seed: int, batch: tuple[int, ...], camera: str, projector: str
) -> None:
    source = generator(seed)
    T_c, T_p = rig(source)
    p = points(T_c, batch, source)
    (c, uv_c), (q, uv_p) = pixels(camera, T_c, p), pixels(projector, T_p, p)
    found = triangulate(c, T_c, uv_c, q, T_p, uv_p)
    assert found.p_world.shape == (*batch, 3)
    assert float((found.p_world - p).abs().max()) < 1e-10
    assert float((found.depth_camera - (p - T_c[:3, 3]).norm(dim=-1)).abs().max()) < 1e-10
    assert float((found.depth_projector - (p - T_p[:3, 3]).norm(dim=-1)).abs().max()) < 1e-10
    assert float(found.gap.max()) < 1e-10
    assert float(epipolar_residual(c, T_c, uv_c, q, T_p, uv_p).abs().max()) < 1e-8


@given(seeds, batches)
def test_closest_approach_is_the_least_squares_solution(seed: int, batch: tuple[int, ...]) -> None:
    source = generator(seed)
    o1, o2 = (torch.randn(*batch, 3, generator=source, dtype=torch.float64) for _ in range(2))
    d1, d2 = directions(batch, source), directions(batch, source)
    s, t = closest_approach(o1, d1, o2, d2)
    assert s.shape == t.shape == batch
    rows = [x.reshape(-1, 3).numpy() for x in (o1, d1, o2, d2)]
    for a1, e1, a2, e2, found_s, found_t in zip(*rows, s.reshape(-1), t.reshape(-1), strict=True):
        best = np.linalg.lstsq(np.stack([e1, -e2], 1), a2 - a1, rcond=None)[0]
        assert np.abs(best - [found_s, found_t]).max() < 1e-8 * (1 + np.abs(best).max())


def test_parallel_rays_have_no_meeting_point() -> None:
    d = torch.tensor([0.0, 0, -1], dtype=torch.float64)
    turned = torch.tensor([1e-7, 0, -1], dtype=torch.float64)
    for other, is_nan in ((d, True), (-d, True), (turned, True), (turned + torch.tensor([1e-5, 0, 0]), False)):
        s, t = closest_approach(torch.zeros(3, dtype=torch.float64), d, torch.ones(3, dtype=torch.float64), other)
        assert (bool(s.isnan()), bool(t.isnan())) == (is_nan, is_nan)


@pytest.mark.parametrize("degrees", [30.0, 5.0, 1.0, 0.2])
def test_small_vergence_in_float32(degrees: float) -> None:
    """Depth keeps the digits that the directions hold: an error of about one part in 10^7 over the vergence."""
    source = generator(0)
    vergence = np.radians(degrees)
    d1 = directions((1000,), source)
    side = torch.linalg.cross(d1, directions((1000,), source))
    side = side / side.norm(dim=-1, keepdim=True)
    d2 = d1 * np.cos(vergence) + side * np.sin(vergence)
    o2 = 3.0 * d1 - 3.0 * d2
    zero = torch.zeros_like(d1)
    s, t = closest_approach(zero.float(), d1.float(), o2.float(), d2.float())
    assert float((s.double() - 3).abs().max()) < 3 * 4e-7 / vergence
    assert float((t.double() - 3).abs().max()) < 3 * 4e-7 / vergence


@pytest.mark.parametrize("projector", sorted(DEVICES))
def test_sigma_depth_is_the_depth_that_moves_the_point_by_a_pixel(projector: str) -> None:
    source = generator(2)
    T_c, T_p = rig(source)
    p = points(T_c, (20,), source)
    (c, uv_c), (q, uv_p) = pixels("lens", T_c, p), pixels(projector, T_p, p)
    found = triangulate(c, T_c, uv_c, q, T_p, uv_p)
    ray = (p - T_c[:3, 3]) / found.depth_camera[:, None]
    step = 1e-5
    _, moved = pixels(projector, T_p, p + step * ray)
    expected = step / (moved - uv_p).norm(dim=-1)
    assert float((found.sigma_depth / expected - 1).abs().max()) < 1e-4


@pytest.mark.parametrize("projector", sorted(DEVICES))
def test_gradients_to_both_poses(projector: str) -> None:
    source = generator(4)
    T_c, T_p = rig(source)
    p = points(T_c, (3,), source)
    (c, uv_c), (q, uv_p) = pixels("lens", T_c, p), pixels(projector, T_p, p)
    uv_p = uv_p + torch.randn(3, 2, generator=source, dtype=torch.float64)

    def everything(xi_c: Tensor, xi_p: Tensor) -> Tensor:
        poses = exp_se3(xi_c) @ T_c, exp_se3(xi_p) @ T_p
        found = triangulate(c, poses[0], uv_c, q, poses[1], uv_p)
        residual = epipolar_residual(c, poses[0], uv_c, q, poses[1], uv_p)
        return torch.cat([found.p_world.flatten(), found.gap, found.sigma_depth, residual])

    zeros = [torch.zeros(6, dtype=torch.float64, requires_grad=True) for _ in range(2)]
    assert torch.autograd.gradcheck(everything, zeros, eps=1e-6, atol=1e-4, rtol=1e-5)


@given(seeds, names)
def test_epipolar_residual_is_the_distance_to_the_curve(seed: int, projector: str) -> None:
    source = generator(seed)
    T_c, T_p = rig(source)
    p = points(T_c, (), source)
    (c, uv_c), (q, uv_p) = pixels("lens", T_c, p), pixels(projector, T_p, p)
    ray = rotate(inverse(T_c), (p - T_c[:3, 3]) / (p - T_c[:3, 3]).norm())
    shift = 2.0 * directions((), source)[:2]

    def distance(depth: float) -> float:
        on_ray = transform(T_c, depth * ray)
        return float((project(q, transform(inverse(T_p), on_ray))[0] - uv_p - shift).norm())

    best = minimize_scalar(distance, bounds=(1.5, 8.0), method="bounded", options={"xatol": 1e-9})
    found = float(epipolar_residual(c, T_c, uv_c, q, T_p, uv_p + shift))
    other = float(epipolar_residual(c, T_c, uv_c, q, T_p, uv_p - shift))
    assert found == pytest.approx(-other, rel=1e-6, abs=1e-9) or projector != "pinhole"  # it has a sign
    # exact for a pinhole; elsewhere the curve is bent by less than this within two pixels
    assert abs(found) == pytest.approx(best.fun, abs=1e-5 if projector == "pinhole" else 2e-3)


def test_points_behind_a_device_have_no_residual() -> None:
    source = generator(7)
    T_c, T_p = rig(source)
    p = points(T_c, (5,), source)
    (c, uv_c), (q, uv_p) = pixels("pinhole", T_c, p), pixels("pinhole", T_p, p)
    half_turn = torch.diag(torch.tensor([-1.0, 1, -1, 1], dtype=torch.float64))
    assert bool(epipolar_residual(c, T_c @ half_turn, uv_c, q, T_p, uv_p).isnan().all())
    assert bool(epipolar_residual(c, T_c, uv_c, q, T_p @ half_turn, uv_p).isnan().all())


def test_rays_that_part_meet_behind() -> None:
    """On the axis of a camera, projector 0.4 to the right: the disparity of depth 3 with the wrong sign."""
    device = DEVICES["pinhole"]
    intrinsics = Intrinsics.of(device, torch.float64)
    T_c, T_p = torch.eye(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64)
    T_p[0, 3] = 0.4
    centre = torch.tensor([device.cx, device.cy], dtype=torch.float64)
    disparity = torch.tensor([device.fl_x * 0.4 / 3, 0], dtype=torch.float64)
    for sign, depth in ((-1, 3.0), (1, -3.0)):
        found = triangulate(intrinsics, T_c, centre, intrinsics, T_p, centre + sign * disparity)
        assert float(found.depth_camera) == pytest.approx(depth)
        assert float(found.depth_projector) == pytest.approx(depth * (1 + (0.4 / 3) ** 2) ** 0.5)
        assert found.p_world.tolist() == pytest.approx([0, 0, -depth], abs=1e-12)


@pytest.mark.parametrize("batch", BATCHES)
def test_batches_of_poses_against_batches_of_pixels(batch: tuple[int, ...]) -> None:
    source = generator(8)
    rigs = [rig(source) for _ in range(2)]
    T_c, T_p = (torch.stack([r[k] for r in rigs]).reshape(2, *[1] * len(batch), 4, 4) for k in (0, 1))
    p = torch.stack([points(r[0], batch, source) for r in rigs])
    (c, uv_c), (q, uv_p) = pixels("lens", T_c, p), pixels("DOE", T_p, p)
    together = epipolar_residual(c, T_c, uv_c, q, T_p, uv_p + 1.0)
    assert together.shape == (2, *batch)
    for i, (one_c, one_p) in enumerate(rigs):
        alone = epipolar_residual(c, one_c, uv_c[i], q, one_p, uv_p[i] + 1.0)
        assert torch.allclose(together[i], alone, atol=1e-10)


# Pyramids of devices end where the rays of their image's corners do; a viewpoint sees all that it should.


DEVICE = Device(w=640, h=400, fl_x=700.0, fl_y=650.0, cx=300.0, cy=210.0)
TURNED = np.array([[0.0, -1.0, 0.0, 3.0], [0.0, 0.0, -1.0, 4.0], [1.0, 0.0, 0.0, 5.0], [0.0, 0.0, 0.0, 1.0]])


def test_corners_lie_on_the_rays_of_the_images_corners():
    points = frustum(DEVICE, TURNED, 2.0)
    np.testing.assert_allclose(points[0], [3, 4, 5])
    for k, (x, y) in enumerate([(0, 0), (640, 0), (640, 400), (0, 400)], 1):
        ray = np.array([(x - 300.0) / 700.0, -(y - 210.0) / 650.0, -1.0])
        expected = TURNED[:3, :3] @ (2.0 * ray / np.linalg.norm(ray)) + [3, 4, 5]
        np.testing.assert_allclose(points[k], expected, atol=1e-6)
    above = TURNED[:3, 1]  # the device's up, in the world
    assert (points[7] - points[5]) @ above > 0 and (points[1] - points[4]) @ above > 0
    np.testing.assert_allclose(np.cross(points[5] - points[1], points[2] - points[1]), 0, atol=1e-9)


def test_the_outline_draws_all_edges():
    drawn = {frozenset(pair) for pair in zip(OUTLINE.tolist(), OUTLINE[1:].tolist(), strict=False)}
    rays, sides = {frozenset((0, k)) for k in (1, 2, 3, 4)}, {frozenset(p) for p in ((1, 2), (2, 3), (3, 4), (4, 1))}
    assert rays | sides | {frozenset((5, 7)), frozenset((7, 6))} <= drawn
    assert drawn - rays - sides <= {frozenset(p) for p in ((1, 5), (5, 7), (7, 6), (6, 2))}  # along the upper edge


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("aspect", [0.6, 1.0, 1.8])
def test_a_viewpoint_sees_every_point_and_is_no_farther_away_than_needed(seed, aspect):
    rng = np.random.default_rng(seed)
    points, centre, up, fov = rng.normal(size=(60, 3)), rng.normal(size=3), rng.normal(size=3), 0.9
    direction = beside(rng.normal(size=3), up)
    view = far_enough(np.concatenate([points, [[np.nan] * 3]]), centre, direction, up, fov, aspect, margin=1.0)
    back = (view.eye - view.centre) / np.linalg.norm(view.eye - view.centre)
    right = np.cross(view.up, back)
    right /= np.linalg.norm(right)
    seen = (points - view.eye) @ np.stack([right, np.cross(back, right), -back], 1)
    assert (seen[:, 2] > 0).all()
    edges = np.abs(seen[:, :2] / seen[:, 2:]) / (math.tan(fov / 2) * np.array([aspect, 1.0]))
    assert edges.max() == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(back, direction, atol=1e-9)
    nothing = far_enough(np.full((1, 3), np.nan), centre, direction, up, fov, aspect)
    assert np.isfinite(nothing.eye).all()


def test_the_direction_is_beside_and_above_the_first_camera():
    z = np.array([0.0, 0.0, 2.0])
    direction = beside(np.array([3.0, 0.0, 0.0]), z)
    assert np.linalg.norm(direction) == pytest.approx(1)
    assert math.asin(direction[2]) == pytest.approx(0.3) and math.atan2(direction[1], direction[0]) == pytest.approx(
        0.35
    )
    for straight in (z, -z):
        assert np.isfinite(beside(straight, z)).all() and np.linalg.norm(beside(straight, z)) == pytest.approx(1)
    assert math.asin(beside(np.array([0.1, 0.0, 5.0]), z)[2]) == pytest.approx(1.2)  # never from straight above
