"""Triangulation of a camera ray and a projector ray, with its uncertainty."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sl_nerfstudio.geometry.devices import Intrinsics, project_jacobian
from sl_nerfstudio.geometry.rays import pixel_rays
from sl_nerfstudio.geometry.se3 import inverse, rotate, transform

_PARALLEL = 1e-12  # sin^2 of the angle between rays, below which they count as parallel


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
    scaled = normal / torch.where(sin2 > _PARALLEL, sin2, torch.nan)[..., None]
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
