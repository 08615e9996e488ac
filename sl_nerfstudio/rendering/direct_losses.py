"""Losses on triangulated points: the field should be zero where camera ray and projector ray meet.

They need no rendering, and their gradient acts over large distances: they shape the surface, and rendering only refines
it.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sl_nerfstudio.field.hash_grid import SignedDistance
from sl_nerfstudio.geometry.devices import MODELS, Intrinsics, project_jacobian, unproject, view_of
from sl_nerfstudio.geometry.lie import inverse, rotate, row_times_rotation, transform
from sl_nerfstudio.geometry.triangulation import closest_approach
from sl_nerfstudio.parallel import compiled, compiled_range
from sl_nerfstudio.rendering.losses import (
    LossConfig,
    behind_loss,
    eikonal_loss,
    facing_loss,
    free_space_loss,
    surface_loss,
)
from sl_nerfstudio.rendering.volume_rendering import sphere_interval

# Where camera rays meet projector rays, in one compiled loop on the CPU, without gradients.
#
# `_measured` has the same as torch operations, each of which takes longer to begin than to do its work.

_PARALLEL = 1e-12  # sin^2 of the angle between rays, below which they count as parallel


def compiled_measures(*tensors: Tensor) -> bool:
    """Whether tensors are float32 on the CPU, and none needs a gradient."""
    return all(x.device.type == "cpu" and x.dtype == torch.float32 and not x.requires_grad for x in tensors)


def measured(
    rays: tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]],
    T_scene_projector: Float[Tensor, "n 4 4"],
    directions: Float[Tensor, "n 3"],
    decoded: Bool[Tensor, "n"],
    projector: Intrinsics,
    noise_px: float,
    px_per_length: float,
    gate: float,
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Distances along camera `rays` (origins, directions), their sigmas, and weights.

    `directions` are those of the projector rays in the projector's axes. Rays that miss each other by more than `gate`
    sigmas, or meet behind a device, have the weight 0.
    """
    found = torch.empty(3, len(decoded))
    arrays = [tensor.detach().contiguous().numpy() for tensor in (*rays, T_scene_projector, directions, decoded)]
    device = MODELS[projector.model].code, projector.params.detach().double().numpy()
    _measure(len(decoded), *arrays, *device, noise_px, px_per_length, gate, found.numpy())
    return found[0], found[1], found[2]


@compiled
def _double(v):
    return float(v[0]), float(v[1]), float(v[2])


@compiled
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled_range
def _measure(first, last, origins, directions, poses, others, decoded, code, parameters, noise, usual, gate, found):
    for k in range(first, last):
        found[0, k], found[1, k], found[2, k] = 1.0, 0.0, 0.0
        T, o1, d1, d2 = poses[k], _double(origins[k]), _double(directions[k]), _double(others[k])
        d2 = _dot(T[0], d2), _dot(T[1], d2), _dot(T[2], d2)
        between = T[0, 3] - o1[0], T[1, 3] - o1[1], T[2, 3] - o1[2]
        normal = _cross(d1, d2)
        sin2 = _dot(normal, normal)
        if not sin2 > _PARALLEL:
            continue
        depth, other = _dot(_cross(between, d2), normal) / sin2, _dot(_cross(between, d1), normal) / sin2
        p = depth * d1[0] - between[0], depth * d1[1] - between[1], depth * d1[2] - between[2]  # from the projector
        x, y, z = row_times_rotation(p[0], p[1], p[2], T)
        _, _, _, ux, uy, uz, vx, vy, vz = view_of(code, x, y, z, parameters)
        x, y, z = row_times_rotation(other * d2[0] - p[0], other * d2[1] - p[1], other * d2[2] - p[2], T)
        gap = np.hypot(ux * x + uy * y + uz * z, vx * x + vy * y + vz * z)
        x, y, z = row_times_rotation(d1[0], d1[1], d1[2], T)
        slope = np.hypot(ux * x + uy * y + uz * z, vx * x + vy * y + vz * z)  # pixels per length
        found[0, k], found[1, k] = depth, noise / max(slope, 1e-9)
        if decoded[k] and gap < gate * noise and depth > 0 and other > 0:
            found[2, k] = min(max(slope / usual, 0.1), 2.0)


GATE = 4.0  # sigmas of the epipolar residual beyond which a decoding counts as wrong
BAND_SIGMAS, LEAST_BAND, MOST_BAND = 4.0, 0.006, 0.03
"""Closer to the measured surface than this, in sigmas of its depth and within bounds in scene units, no sign is
required. A wider band would allow a surface that is folded within it and passes through the points inside out."""
NEAR_SHARE, NEAR_BANDS = 0.5, 4.0  # this share of the points in front is within so many bands of the surface
BEHIND, FACING = 0.3, 0.1  # weights of the sign behind the surface, and of its normal, among the terms of free space


@dataclass(frozen=True)
class DecodingNoise:
    """How well coordinates are decoded, and how pattern pixels relate to lengths."""

    px: Float[Tensor, ""] | float  # 1 sigma of the epipolar residual, pattern pixels
    px_per_length: Float[Tensor, ""] | float  # median slope along camera rays, pattern pixels per scene unit


@dataclass(frozen=True)
class MeasuredRays:
    """Camera rays of some pixels and the pattern coordinates decoded there; scene frame."""

    origins: Float[Tensor, "n 3"]
    directions: Float[Tensor, "n 3"]
    T_scene_projector: Float[Tensor, "n 4 4"]
    uv_projector: Float[Tensor, "n 2"]  # NaN where not decoded: such rays do not count

    def chosen(self, index: Bool[Tensor, "n"]) -> "MeasuredRays":
        """Some of the rays."""
        return MeasuredRays(*(values[index] for values in vars(self).values()))


def random_points(count: int, device: torch.device) -> Float[Tensor, "n 3"]:
    """Points uniform in the unit ball."""
    direction = torch.randn(count, 3, device=device)
    radius = torch.rand(count, 1, device=device) ** (1 / 3)
    return direction / direction.norm(dim=-1, keepdim=True) * radius


def field_losses(field: SignedDistance, points: Float[Tensor, "n 3"], weights: LossConfig) -> dict[str, Tensor]:
    """Only the Eikonal term, at some points of the scene."""
    gradient = field.sdf_and_gradient(points)[1]
    return {"eikonal": weights.eikonal * eikonal_loss(gradient, torch.ones_like(points[:, 0], dtype=torch.bool))}


def direct_losses(
    field: SignedDistance,
    rays: MeasuredRays,
    projector: Intrinsics,
    noise: DecodingNoise,
    eikonal_points: Float[Tensor, "m 3"],
    weights: LossConfig,
    width: Float[Tensor, ""] | float,
) -> dict[str, Tensor]:
    """Surface, free-space and Eikonal terms of decoded rays; `width` is that of the surface term's kernel."""
    o, d = rays.origins, rays.directions
    decoded = rays.uv_projector.isfinite().all(-1)
    depth, sigma, weight = _measured(rays, decoded, projector, noise)
    p = o + depth[:, None] * d
    with torch.no_grad():
        near, _ = sphere_interval(o, d)
        before, after = _either_side(near, depth, (BAND_SIGMAS * sigma).clamp(LEAST_BAND, MOST_BAND))
        gap = (depth - before).clamp_min(0)
    inside, n = (p.detach().norm(dim=-1) < 1) & (weight > 0), len(p)
    sdf, gradient = field.sdf_and_gradient(torch.cat([p.detach(), eikonal_points]))
    at_surface = sdf[:n]
    if p.requires_grad:  # first order in the poses: the slope is a constant
        at_surface = at_surface + (gradient[:n].detach() * (p - p.detach())).sum(-1)
    signs = field.sdf(torch.cat([o + before[:, None] * d, o + after[:, None] * d]).detach())
    counts = weight * inside
    free_space = (
        free_space_loss(signs[:n], (0.3 * gap).clamp_max(MOST_BAND), inside)
        + BEHIND * behind_loss(signs[n:], inside)
        + FACING * facing_loss(gradient[:n], d.detach(), counts)
    )
    with_slope = torch.cat([decoded, torch.ones_like(eikonal_points[:, 0], dtype=torch.bool)])
    return {
        "surface": weights.surface * surface_loss(at_surface, counts, width),
        "free_space": weights.free_space * free_space,
        "eikonal": weights.eikonal * eikonal_loss(gradient, with_slope),
    }


def _either_side(
    near: Float[Tensor, "n"], depth: Float[Tensor, "n"], band: Float[Tensor, "n"]
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Random distances along rays: anywhere in front of the band around a measured depth, and just behind it."""
    u, v = torch.rand(2, *depth.shape, device=depth.device)
    anywhere = near + (depth - band - near).clamp_min(0) * u
    close = (depth - band * (1 + (NEAR_BANDS - 1) * u)).maximum(near)
    return torch.where(torch.rand_like(depth) < NEAR_SHARE, close, anywhere), depth + band * (1 + v)


def _measured(
    rays: MeasuredRays, decoded: Bool[Tensor, "n"], projector: Intrinsics, noise: DecodingNoise
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Distance along camera rays at which projector rays meet them, its sigma, and a weight: 0 if decoded wrongly."""
    o, d, T_scene_projector = rays.origins, rays.directions, rays.T_scene_projector
    # a ray without coordinates gets those of the pattern's middle: NaN would spoil the gradients of all
    uv = torch.where(decoded[:, None], rays.uv_projector, projector.params[2:4])
    directions = unproject(projector, uv)
    if compiled_measures(o, d, T_scene_projector, directions):
        px, px_per_length = float(noise.px), float(noise.px_per_length)
        return measured((o, d), T_scene_projector, directions, decoded, projector, px, px_per_length, GATE)
    d_projector = rotate(T_scene_projector, directions)
    o_projector = T_scene_projector[:, :3, 3]
    depth, depth_projector = closest_approach(o, d, o_projector, d_projector)
    with torch.no_grad():
        p = o + depth[:, None] * d
        T = inverse(T_scene_projector)
        J = project_jacobian(projector, transform(T, p))
        offset = (o_projector + depth_projector[:, None] * d_projector) - p
        gap_px = (J * rotate(T, offset)[:, None, :]).sum(-1).norm(dim=-1)
        slope = (J * rotate(T, d)[:, None, :]).sum(-1).norm(dim=-1)  # pixels per length
        good = decoded & (gap_px < GATE * noise.px) & (depth > 0) & (depth_projector > 0)
        weight = good * (slope / noise.px_per_length).clamp(0.1, 2.0)
        sigma = noise.px / slope.clamp_min(1e-9)
    return torch.nan_to_num(depth, nan=1.0), torch.nan_to_num(sigma), torch.nan_to_num(weight)
