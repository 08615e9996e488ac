"""Triangulation of a camera ray and a projector ray, with its uncertainty."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project, project_jacobian, unproject
from sl_nerfstudio.geometry.lie import inverse, rotate, transform

# Pixel centres, the rays of pixels in the world, and the pixels of points in the world.


def pixel_centres(device: Device, dtype: torch.dtype = torch.float32) -> Float[Tensor, "h w 2"]:
    """Coordinates (x, y) of all pixel centres of a device, starting with (0.5, 0.5)."""
    y, x = torch.meshgrid(
        torch.arange(device.h, dtype=dtype) + 0.5, torch.arange(device.w, dtype=dtype) + 0.5, indexing="ij"
    )
    return torch.stack([x, y], -1)


def pixel_rays(
    intrinsics: Intrinsics, T_world_device: Float[Tensor, "*#batch 4 4"], uv: Float[Tensor, "*#batch 2"]
) -> tuple[Float[Tensor, "*#batch 3"], Float[Tensor, "*#batch 3"]]:
    """Origin and unit direction, in the world, of the rays through pixels `uv`."""
    d_world = rotate(T_world_device, unproject(intrinsics, uv))
    return T_world_device[..., :3, 3].expand_as(d_world), d_world


def world_pixels(
    device: Device, T_world_device: Float[ndarray, "4 4"], p_world: Float[ndarray, "n 3"]
) -> tuple[Float64[ndarray, "n 2"], Bool[ndarray, "n"]]:
    """Pixels of points in the world, and whether each is in front of the device and inside its image."""
    T = inverse(torch.as_tensor(T_world_device, dtype=torch.float64))
    p_device = transform(T, torch.as_tensor(p_world, dtype=torch.float64))
    uv, in_front = project(Intrinsics.of(device, torch.float64), p_device)
    u, v = uv.numpy().T
    return uv.numpy(), in_front.numpy() & (u >= 0) & (v >= 0) & (u < device.w) & (v < device.h)


PARALLEL = 1e-12  # sin^2 of the angle between rays, below which they count as parallel


@dataclass(frozen=True)
class Triangulation:
    """Triangulated points of correspondences, and measures of their quality."""

    p_world: Float[Tensor, "*batch 3"]  # midpoint of the rays' closest approach; NaN if they are parallel
    depth_camera: Float[Tensor, "*batch"]  # distance along the unit camera ray; negative behind the camera
    depth_projector: Float[Tensor, "*batch"]  # the same along the projector ray
    gap: Float[Tensor, "*batch"]  # distance between the rays at their closest approach
    sigma_depth: Float[Tensor, "*batch"]  # 1 sigma along the camera ray for 1 px of projector noise


def closest_approach(
    o1: Float[Tensor, "*#batch 3"],
    d1: Float[Tensor, "*#batch 3"],
    o2: Float[Tensor, "*#batch 3"],
    d2: Float[Tensor, "*#batch 3"],
) -> tuple[Float[Tensor, "*#batch"], Float[Tensor, "*#batch"]]:
    """Distances along two lines (unit directions) to the points where they come closest to each other.

    NaN if the angle between the lines is below 1e-6 rad.
    """
    between, d1, d2 = torch.broadcast_tensors(o2 - o1, d1, d2)
    # Cross products, because 1 - cos^2 of the angle would lose all digits of float32 at small baselines.
    normal = torch.linalg.cross(d1, d2)
    sin2 = (normal * normal).sum(-1)
    scaled = normal / torch.where(sin2 > PARALLEL, sin2, torch.nan)[..., None]
    return (torch.linalg.cross(between, d2) * scaled).sum(-1), (torch.linalg.cross(between, d1) * scaled).sum(-1)


def triangulate(
    camera: Intrinsics,
    T_world_camera: Float[Tensor, "*#batch 4 4"],
    uv_camera: Float[Tensor, "*#batch 2"],
    projector: Intrinsics,
    T_world_projector: Float[Tensor, "*#batch 4 4"],
    uv_projector: Float[Tensor, "*#batch 2"],
) -> Triangulation:
    """Midpoints between camera rays and projector rays; differentiable with respect to both poses.

    `sigma_depth` is 1 / |d uv_projector / d depth|: how far the point moves along the camera ray
    per projector pixel. Multiply it by the coordinate noise in pixels.
    """
    o_c, d_c = pixel_rays(camera, T_world_camera, uv_camera)
    o_p, d_p = pixel_rays(projector, T_world_projector, uv_projector)
    s, t = closest_approach(o_c, d_c, o_p, d_p)
    p_c, p_p = o_c + s[..., None] * d_c, o_p + t[..., None] * d_p
    T_projector_world = inverse(T_world_projector)
    jacobian = project_jacobian(projector, transform(T_projector_world, p_c))
    slope = (jacobian * rotate(T_projector_world, d_c)[..., None, :]).sum(-1)
    return Triangulation(
        p_world=(p_c + p_p) / 2,
        depth_camera=s,
        depth_projector=t,
        gap=(p_c - p_p).norm(dim=-1),
        sigma_depth=1 / slope.norm(dim=-1).clamp_min(1e-12),
    )


# Epipolar geometry of a camera and a projector.


def triangulate_pixels(
    camera: Device,
    projector: Device,
    T_world_camera: Float64[ndarray, "4 4"],
    T_world_projector: Float64[ndarray, "4 4"],
    coords: Float[ndarray, "_h _w 2"],
    row: Int64[ndarray, "n"],
    column: Int64[ndarray, "n"],
) -> Triangulation:
    """The points that some decoded pixels of a frame see, by its map of projector coordinates."""
    uv = torch.from_numpy(np.stack([column, row], -1) + 0.5)
    uv_projector = torch.from_numpy(coords[row, column].astype(np.float64))
    K_c, K_p = (Intrinsics.of(device, torch.float64) for device in (camera, projector))
    T_c, T_p = torch.from_numpy(T_world_camera), torch.from_numpy(T_world_projector)
    return triangulate(K_c, T_c, uv, K_p, T_p, uv_projector)


def epipolar_residual(
    camera: Intrinsics,
    T_world_camera: Float[Tensor, "*#batch 4 4"],
    uv_camera: Float[Tensor, "*#batch 2"],
    projector: Intrinsics,
    T_world_projector: Float[Tensor, "*#batch 4 4"],
    uv_projector: Float[Tensor, "*#batch 2"],
) -> Float[Tensor, "*#batch"]:
    """Signed distance, in projector pixels, of `uv_projector` from the epipolar curve of `uv_camera`.

    The curve is the image of the camera ray in the projector. It is linearised where the two rays come
    closest to each other, so it is valid for pinhole, distorted and DOE projectors alike.
    NaN if that point is behind either device or the rays are parallel.
    """
    o_c, d_c = pixel_rays(camera, T_world_camera, uv_camera)
    o_p, d_p = pixel_rays(projector, T_world_projector, uv_projector)
    depth, depth_projector = closest_approach(o_c, d_c, o_p, d_p)
    T_projector_world = inverse(T_world_projector)
    p_projector = transform(T_projector_world, o_c + depth[..., None] * d_c)
    uv, in_front = project(projector, p_projector)
    tangent = (project_jacobian(projector, p_projector) * rotate(T_projector_world, d_c)[..., None, :]).sum(-1)
    tangent = tangent / tangent.norm(dim=-1, keepdim=True)
    offset = uv - uv_projector
    residual = tangent[..., 0] * offset[..., 1] - tangent[..., 1] * offset[..., 0]
    valid = in_front & (depth > 0) & (depth_projector > 0)
    return residual.where(valid, residual.new_tensor(float("nan")))


# From where to look at a scene: beside the first camera, and far enough away to see everything.

_BESIDE, _ABOVE, _STEEPEST = 0.35, 0.3, 1.2  # radian


@dataclass(frozen=True)
class Viewpoint:
    """An eye, the point it looks at, and what is upwards for it."""

    eye: Float64[ndarray, "3"]
    centre: Float64[ndarray, "3"]
    up: Float64[ndarray, "3"]


def beside(towards: Float64[ndarray, "3"], up: Float64[ndarray, "3"]) -> Float64[ndarray, "3"]:
    """A unit direction a little beside `towards`, and nearer to `up`; both directions lead away from the object."""
    z = up / np.linalg.norm(up)
    level = towards - (towards @ z) * z
    if np.linalg.norm(level) < 1e-6 * np.linalg.norm(towards):  # straight above: any horizontal direction will do
        level = np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))])
    x = level / np.linalg.norm(level)
    elevation = math.asin(max(-1.0, min(1.0, float(towards @ z) / float(np.linalg.norm(towards)))))
    elevation = min(elevation + _ABOVE, _STEEPEST)
    turned = math.cos(_BESIDE) * x + math.sin(_BESIDE) * np.cross(z, x)
    return math.cos(elevation) * turned + math.sin(elevation) * z


def far_enough(
    points: Float64[ndarray, "n 3"],
    centre: Float64[ndarray, "3"],
    direction: Float64[ndarray, "3"],
    up: Float64[ndarray, "3"],
    vertical_fov: float,
    aspect: float,
    margin: float = 1.1,
) -> Viewpoint:
    """The nearest eye in `direction` (unit) from `centre` that sees all points, with a margin around them.

    `vertical_fov` is in radian, `aspect` is width by height of the picture. Points that are not finite do not count.
    """
    offset = points[np.isfinite(points).all(1)] - centre
    right = np.cross(up, direction)
    right = right / np.linalg.norm(right)
    across, along = np.abs(offset @ right), offset @ direction
    upwards = np.abs(offset @ np.cross(direction, right))
    tangent = math.tan(vertical_fov / 2)
    needed = along + margin * np.maximum(across / (tangent * aspect), upwards / tangent)
    distance = float(needed.max()) if len(needed) else 1.0
    return Viewpoint(centre + distance * direction, centre, up)


_COMMON_UP = 0.3  # smallest length of the cameras' mean up direction with which it counts as a common one


def upright(T_world_camera: Float[ndarray, "n 4 4"]) -> Float[ndarray, "3 3"]:
    """Rotation from world to scene axes: z is the cameras' mean up, x as close as possible to the first camera's right.

    If the cameras roll so much that they have no common up, z is the first camera's up.
    """
    up = T_world_camera[:, :3, 1].mean(0)
    if np.linalg.norm(up) < _COMMON_UP:
        up = T_world_camera[0, :3, 1]
    z = up / np.linalg.norm(up)
    # right and back of the first camera are perpendicular: they cannot both be parallel to z
    across = [axis - (axis @ z) * z for axis in T_world_camera[0, :3, [0, 2]]]
    right, back = (np.linalg.norm(axis) for axis in across)
    x = across[0] / right if right > 0.1 else np.cross(z, across[1] / back)
    return np.stack([x, np.cross(z, x), z])


# Outlines of cameras and projectors, for pictures of a scene.

_MARK_WIDTH, _MARK_HEIGHT = 0.25, 0.3  # of the mark above the upper edge, as shares of the image's width and height

OUTLINE: Int64[ndarray, "14"] = np.array([0, 1, 2, 0, 3, 4, 0, 4, 1, 5, 7, 6, 2, 3])
"""Indices into the points of `frustum`: one line that draws all edges of the pyramid and the mark."""


def frustum(device: Device, T_world_device: Float64[ndarray, "4 4"], length: float) -> Float64[ndarray, "8 3"]:
    """Points of a pyramid in world axes.

    The centre of projection; the image's corners, each at `length` along its own ray, clockwise from the upper left as
    the device sees it; and three points of a mark above the upper edge: on its left, on its right, and its tip.
    """
    w, h = float(device.w), float(device.h)
    uv = [[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]]
    rays = unproject(Intrinsics.of(device, torch.float64), torch.tensor(uv, dtype=torch.float64)).numpy()
    corners = np.concatenate([np.zeros((1, 3)), length * rays])
    left, right = (corners[1] + (0.5 + side * _MARK_WIDTH) * (corners[2] - corners[1]) for side in (-0.5, 0.5))
    tip = (left + right) / 2 + _MARK_HEIGHT * (corners[1] - corners[4])
    points = np.concatenate([corners, [left, right, tip]])
    return points @ T_world_device[:3, :3].T + T_world_device[:3, 3]
