"""Derivatives of residuals by surface, poses and intrinsics, against differences of rays cut with a plane."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from sl_nerfstudio.geometry.devices import (
    Device,
    Intrinsics,
    project,
    unproject,
)
from sl_nerfstudio.geometry.lie import (
    exp_se3,
    inverse,
    rotate,
    transform,
)
from sl_nerfstudio.meshing.uncertainty import (
    FrameDevices,
    packed_devices,
    point_equations,
    view_surface,
)
from sl_nerfstudio.meshing.visibility import VIEW, derive_residual, view_point
from tests.bundle_adjustment.analytic import look_at

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
    view = view_surface(d, p, normal)
    uv = view.uv_camera
    assert torch.allclose(view.uv_projector, on_plane(d, uv, p, normal), atol=1e-9)
    moved = [on_plane(d, uv, p + sign * STEP * normal, normal) for sign in (1, -1)]
    assert torch.allclose(view.slope, (moved[0] - moved[1]) / (2 * STEP), rtol=1e-6, atol=1e-5)
    for column, way in enumerate(torch.eye(2, dtype=torch.float64)):
        beside = [on_plane(d, uv + sign * STEP * way, p, normal) for sign in (1, -1)]
        assert torch.allclose(view.by_pixel[..., column], (beside[0] - beside[1]) / (2 * STEP), rtol=1e-6, atol=1e-5)
    found = derivatives(d, p, normal)
    for column, way in enumerate(torch.eye(18, dtype=torch.float64)):
        after = [on_plane(changed(d, sign * STEP * way), uv, p, normal) for sign in (1, -1)]
        expected = (after[0] - after[1]) / (2 * STEP)
        assert torch.allclose(found[..., column], expected, rtol=2e-5, atol=2e-4), column


def test_pixels_on_an_area_are_those_of_its_projected_corners():
    d, (p, normal) = frame_of(LIGHTS[0]), surface()
    view = view_surface(d, p, normal)
    side = 1e-4
    a = torch.nn.functional.normalize(torch.linalg.cross(normal, torch.ones_like(normal)), dim=-1)
    b = torch.linalg.cross(normal, a)
    T = inverse(d.T_world_camera)
    corner, x, y = (project(d.camera, transform(T, q))[0] for q in (p, p + side * a, p + side * b))
    area = torch.linalg.det(torch.stack([x - corner, y - corner], -1)).abs()
    assert torch.allclose(view.pixels_per_area, area / side**2, rtol=1e-3)


def test_a_point_is_seen_where_both_devices_project_it():
    d, (p, _) = frame_of(LIGHTS[0]), surface()
    by_point, by_rest = point_equations(d, p)

    def seen(devices: FrameDevices, q: Tensor) -> Tensor:
        T = inverse(devices.T_world_camera)
        light = inverse(devices.T_camera_projector) @ T
        return torch.cat(
            [project(devices.camera, transform(T, q))[0], project(devices.projector, transform(light, q))[0]], -1
        )

    for column, way in enumerate(torch.eye(3, dtype=torch.float64)):
        there = (seen(d, p + STEP * way) - seen(d, p - STEP * way)) / (2 * STEP)
        assert torch.allclose(by_point[..., column], there, rtol=1e-6, atol=1e-5)
    for column, way in enumerate(torch.eye(18, dtype=torch.float64)):
        there = (seen(changed(d, STEP * way), p) - seen(changed(d, -STEP * way), p)) / (2 * STEP)
        assert torch.allclose(by_rest[..., column], there, rtol=2e-5, atol=2e-4), column
