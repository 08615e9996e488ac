"""How the residuals of one frame depend on the surface, on the frame's poses and on the intrinsics.

A surface that is locally a plane moves by s along its normal, or the frame's poses change while its decoded coordinates
stay. The residual is the predicted minus the decoded coordinate of a camera pixel, in projector pixels. Increments are
those of `bundle_adjustment.residuals`; intrinsics are shares of the focal length (`IntrinsicsChange.values`).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.self_calibration import by_intrinsics
from sl_nerfstudio.geometry.devices import Intrinsics, project, project_jacobian
from sl_nerfstudio.geometry.se3 import hat, inverse, rotate, transform


@dataclass(frozen=True)
class FrameDevices:
    """Camera and projector of one frame, batch ()."""

    camera: Intrinsics
    projector: Intrinsics
    T_world_camera: Float[Tensor, "4 4"]
    T_camera_projector: Float[Tensor, "4 4"]


@dataclass(frozen=True)
class SurfaceView:
    """Points of a surface as one frame sees them."""

    p_camera: Float[Tensor, "n 3"]
    uv_camera: Float[Tensor, "n 2"]
    uv_projector: Float[Tensor, "n 2"]  # predicted
    by_point: Float[Tensor, "n 2 3"]  # of the predicted coordinate by the point in the camera's axes
    slope: Float[Tensor, "n 2"]  # of the residual, projector pixels per unit of length along the normal
    by_pixel: Float[Tensor, "n 2 2"]  # of the predicted coordinate by the camera pixel, along the surface
    pixels_per_area: Float[Tensor, "n"]  # camera pixels on a unit of the surface's area
    ray_angle: Float[Tensor, "n"]  # between camera ray and projector ray, radian


def view_surface(d: FrameDevices, p_world: Float[Tensor, "n 3"], normal: Float[Tensor, "n 3"]) -> SurfaceView:
    """The view of points with unit normals, which must be in front of both devices and face the camera."""
    T_camera_world = inverse(d.T_world_camera)
    p, n = transform(T_camera_world, p_world), rotate(T_camera_world, normal)
    ray = torch.nn.functional.normalize(p, dim=-1)
    by_point = _projector_jacobian(d, p)
    slope = (by_point @ ray[..., None]).squeeze(-1) / (ray * n).sum(-1, keepdim=True)
    K = project_jacobian(d.camera, p)
    back = p - d.T_camera_projector[:3, 3]
    return SurfaceView(
        p_camera=p,
        by_point=by_point,
        uv_camera=project(d.camera, p)[0],
        uv_projector=project(d.projector, transform(inverse(d.T_camera_projector), p))[0],
        slope=slope,
        by_pixel=by_point @ _along_surface(K, n),
        pixels_per_area=torch.linalg.det(torch.cat([K, n[:, None]], 1)).abs(),
        ray_angle=torch.acos((ray * torch.nn.functional.normalize(back, dim=-1)).sum(-1).clamp(-1, 1)),
    )


def by_poses_and_intrinsics(
    d: FrameDevices, p_world: Float[Tensor, "n 3"], normal: Float[Tensor, "n 3"], view: SurfaceView
) -> Float[Tensor, "n 2 18"]:
    """Derivatives of the residual by delta and rho of the frame, then by the six intrinsics."""
    # A frame that moves carries along what it measured: only the motion across the surface changes the residual.
    by_delta = -view.slope[:, :, None] * torch.cat([normal, torch.linalg.cross(p_world, normal)], -1)[:, None]
    by_rho = torch.cat([-view.by_point, view.by_point @ hat(view.p_camera)], -1)
    by_camera = -view.by_pixel @ by_intrinsics(d.camera, view.uv_camera)
    return torch.cat([by_delta, by_rho, by_camera, by_intrinsics(d.projector, view.uv_projector)], -1)


def point_equations(d: FrameDevices, p_world: Float[Tensor, "n 3"]) -> tuple[Tensor, Tensor]:
    """Derivatives of the residuals of a *point*, which the frame sees at a camera pixel and at a projector pixel.

    Returns those by the point (n, 4, 3), and by delta, rho and the intrinsics (n, 4, 18). Unlike a surface, a point
    cannot slide along itself: lengths between points depend on all of its motion.
    """
    p = transform(inverse(d.T_world_camera), p_world)
    K, P = project_jacobian(d.camera, p), _projector_jacobian(d, p)
    R = d.T_world_camera[:3, :3].T
    by_point = torch.cat([K, P], 1) @ R
    by_delta = torch.cat([-by_point, by_point @ hat(p_world)], -1)
    by_rho = torch.cat([torch.zeros_like(by_delta[:, :2]), torch.cat([-P, P @ hat(p)], -1)], 1)
    uv_camera = project(d.camera, p)[0]
    uv_projector = project(d.projector, transform(inverse(d.T_camera_projector), p))[0]
    zero = p.new_zeros(len(p), 2, 3)
    camera = torch.cat([by_intrinsics(d.camera, uv_camera), zero], 1)
    projector = torch.cat([zero, by_intrinsics(d.projector, uv_projector)], 1)
    return by_point, torch.cat([by_delta, by_rho, camera, projector], -1)


def _projector_jacobian(d: FrameDevices, p_camera: Float[Tensor, "n 3"]) -> Float[Tensor, "n 2 3"]:
    T = inverse(d.T_camera_projector)
    return project_jacobian(d.projector, transform(T, p_camera)) @ T[:3, :3]


def _along_surface(K: Float[Tensor, "n 2 3"], normal: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 2"]:
    """Motion along the tangent plane that moves the camera pixel by one in x and in y."""
    return torch.linalg.inv(torch.cat([K, normal[:, None]], 1))[..., :2]
