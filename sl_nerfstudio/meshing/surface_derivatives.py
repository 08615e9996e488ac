"""How the residuals of one frame depend on the surface, on the frame's poses and on the intrinsics.

A surface that is locally a plane moves by s along its normal, or the frame's poses change while its decoded coordinates
stay. The residual is the predicted minus the decoded coordinate of a camera pixel, in projector pixels. Increments are
those of `bundle_adjustment.residuals`; intrinsics are shares of the focal length (`IntrinsicsChange.values`).
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.self_calibration import by_intrinsics
from sl_nerfstudio.compiled import compiled_range
from sl_nerfstudio.geometry.devices import Intrinsics, project, project_jacobian
from sl_nerfstudio.geometry.devices.models import MODELS
from sl_nerfstudio.geometry.se3 import hat, inverse, transform
from sl_nerfstudio.meshing.loops import derivatives as loops


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


def packed_devices(d: FrameDevices) -> Float[ndarray, "devices"]:
    """The devices of a frame as compiled loops read them."""
    T_camera_world, T_projector_camera = inverse(d.T_world_camera), inverse(d.T_camera_projector)
    codes = [float(MODELS[device.model].code) for device in (d.camera, d.projector)]
    matrices = [T[:3].reshape(-1).numpy() for T in (T_camera_world, T_projector_camera)]
    return np.concatenate(
        [*matrices, d.T_camera_projector[:3, 3].numpy(), d.camera.params.numpy(), d.projector.params.numpy(), codes]
    )


def view_surface(d: FrameDevices, p_world: Float[Tensor, "n 3"], normal: Float[Tensor, "n 3"]) -> SurfaceView:
    """The view of points with unit normals, which must be in front of both devices and face the camera."""
    rows = np.empty((len(p_world), loops.VIEW))
    _view_points(len(rows), packed_devices(d), p_world.numpy(), normal.numpy(), rows)
    views = torch.from_numpy(rows)
    return SurfaceView(
        p_camera=views[:, loops.P_CAMERA : loops.BY_POINT],
        by_point=views[:, loops.BY_POINT : loops.UV_CAMERA].unflatten(1, (2, 3)),
        uv_camera=views[:, loops.UV_CAMERA : loops.UV_PROJECTOR],
        uv_projector=views[:, loops.UV_PROJECTOR : loops.SLOPE],
        slope=views[:, loops.SLOPE : loops.BY_PIXEL],
        by_pixel=views[:, loops.BY_PIXEL : loops.AREA].unflatten(1, (2, 2)),
        pixels_per_area=views[:, loops.AREA],
        ray_angle=views[:, loops.ANGLE],
    )


@compiled_range
def _view_points(first, last, devices, points, normals, rows):
    for i in range(first, last):
        loops.view_point(devices, points[i], normals[i], rows[i])


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
