"""Losses on triangulated points: the field is zero where camera ray and projector ray meet.

They need no rendering, and their gradient reaches far: they carry the fit where rendering only polishes it.
"""

from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float
from torch import Tensor

from sl_nerfstudio.geometry.devices import Intrinsics, project_jacobian, unproject
from sl_nerfstudio.geometry.epipolar import epipolar_residual
from sl_nerfstudio.geometry.se3 import inverse, rotate, transform
from sl_nerfstudio.geometry.triangulation import closest_approach, triangulate
from sl_nerfstudio.rendering.losses import behind_loss, eikonal_loss, facing_loss, free_space_loss, surface_loss
from sl_nerfstudio.rendering.ray_samples import sphere_interval
from sl_nerfstudio.scan import Scan

if TYPE_CHECKING:
    from sl_nerfstudio.dataparser.samples import PixelSamples
    from sl_nerfstudio.model.model import SLModel

_GATE = 4.0  # sigmas of the epipolar residual beyond which a decoding counts as wrong
_BAND_SIGMAS, _LEAST_BAND, _MOST_BAND = 4.0, 0.006, 0.03
"""Nearer to the measured surface than this, in sigmas of its depth and within bounds in scene units, no sign is asked
for. A wider band leaves room for a surface that is folded within it, and meets the points with the inside out."""
_NEAR_SHARE, _NEAR_BANDS = 0.5, 4.0  # of the points in front, this share within so many bands of the surface
_WIDTH_START, _WIDTH_END = 0.2, 0.02  # scene units: kernel width of the surface term over the run
_PER_FRAME = 2000


@torch.no_grad()
def measure(
    scan: Scan, samples: "PixelSamples", T_scene_camera: Tensor, T_scene_projector: Tensor
) -> tuple[float, float]:
    """Decoding noise (robust 1 sigma of the epipolar residual, pattern pixels) and median pixels per scene length."""
    residuals, slopes = [], []
    projector = Intrinsics.of(scan.projector, torch.float64)
    for number, frame in enumerate(scan.frames):
        first, last = int(samples.first[number]), int(samples.first[number + 1])
        if last == first:
            continue
        pixels = samples.at(torch.linspace(first, last - 1, min(_PER_FRAME, last - first)).round().long())
        ok = pixels.decoded
        camera = Intrinsics.of(frame.camera, torch.float64)
        arguments = (
            camera,
            T_scene_camera[number],
            pixels.uv[ok].double(),
            projector,
            T_scene_projector[number],
            pixels.coords[ok].double(),
        )
        residuals.append(epipolar_residual(*arguments).abs())
        slopes.append(1 / triangulate(*arguments).sigma_depth)
    residual, slope = torch.cat(residuals), torch.cat(slopes)
    finite = residual.isfinite() & slope.isfinite()
    return max(float(residual[finite].median()) * 1.4826, 0.02), float(slope[finite].median())


def direct_losses(model: "SLModel", outputs: dict[str, Any], batch: dict[str, Tensor]) -> dict[str, Tensor]:
    """Surface, free-space and Eikonal terms of a batch."""
    w = model.config.losses
    random_points = _ball(model.config.sampling.eikonal_points, batch["coords"])
    if w.surface == 0 and w.free_space == 0:
        return {"eikonal": w.eikonal * eikonal_loss(model.field.sdf_and_gradient(random_points)[1])}
    decoded = batch["decoded"][:, 0]
    o, d = outputs["origins"][decoded], outputs["directions"][decoded]
    T_scene_projector, uv = outputs["T_scene_projector"][decoded], batch["coords"][decoded]
    depth, sigma, weight = _measured(model, o, d, T_scene_projector, uv)
    p = o + depth[:, None] * d
    with torch.no_grad():
        near, _, _ = sphere_interval(o, d)
        before, after = _either_side(near, depth, (_BAND_SIGMAS * sigma).clamp(_LEAST_BAND, _MOST_BAND))
        gap = (depth - before).clamp_min(0)
    inside = (p.detach().norm(dim=-1) < 1) & (weight > 0)
    n = len(p)
    points = torch.cat([p.detach(), random_points])
    sdf, gradient = model.field.sdf_and_gradient(points)
    at_surface = sdf[:n]
    if p.requires_grad:  # first order in the poses: the slope is a constant
        at_surface = at_surface + (gradient[:n].detach() * (p - p.detach())).sum(-1)
    signs = model.field.sdf(torch.cat([o + before[:, None] * d, o + after[:, None] * d]).detach())
    share = min(int(model.step_now) / max(model.config.schedule_iterations, 1), 1.0)
    width = _WIDTH_START * (_WIDTH_END / _WIDTH_START) ** share
    counts = weight * inside
    return {
        "surface": w.surface * surface_loss(at_surface, counts, width),
        "free_space": w.free_space
        * (
            free_space_loss(signs[:n][inside], (0.3 * gap[inside]).clamp_max(_MOST_BAND))
            + 0.3 * behind_loss(signs[n:][inside])
            + 0.1 * facing_loss(gradient[:n], d.detach(), counts)
        ),
        "eikonal": w.eikonal * eikonal_loss(gradient),
    }


def _either_side(
    near: Float[Tensor, "n"], depth: Float[Tensor, "n"], band: Float[Tensor, "n"]
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Random distances along rays: anywhere before the band around a measured depth, and just behind it."""
    u, v = torch.rand(2, *depth.shape, device=depth.device)
    anywhere = near + (depth - band - near).clamp_min(0) * u
    close = (depth - band * (1 + (_NEAR_BANDS - 1) * u)).maximum(near)
    return torch.where(torch.rand_like(depth) < _NEAR_SHARE, close, anywhere), depth + band * (1 + v)


def _measured(
    model: "SLModel", o: Tensor, d: Tensor, T_scene_projector: Tensor, uv: Tensor
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Distance along camera rays at which projector rays meet them, its sigma, and a weight: 0 if decoded wrongly."""
    projector = model.projector
    d_projector = rotate(T_scene_projector, unproject(projector, uv))
    o_projector = T_scene_projector[:, :3, 3]
    depth, depth_projector = closest_approach(o, d, o_projector, d_projector)
    with torch.no_grad():
        p = o + depth[:, None] * d
        T = inverse(T_scene_projector)
        J = project_jacobian(projector, transform(T, p))
        offset = (o_projector + depth_projector[:, None] * d_projector) - p
        gap_px = (J * rotate(T, offset)[:, None, :]).sum(-1).norm(dim=-1)
        slope = (J * rotate(T, d)[:, None, :]).sum(-1).norm(dim=-1)  # pixels per length
        good = (gap_px < _GATE * model.noise_px) & (depth > 0) & (depth_projector > 0)
        weight = good * (slope / model.px_per_length).clamp(0.1, 2.0)
        sigma = model.noise_px / slope.clamp_min(1e-9)
    return torch.nan_to_num(depth, nan=1.0), torch.nan_to_num(sigma), torch.nan_to_num(weight)


def _ball(count: int, like: Tensor) -> Float[Tensor, "n 3"]:
    """Points uniform in the unit ball."""
    direction = torch.randn(count, 3, device=like.device)
    radius = torch.rand(count, 1, device=like.device) ** (1 / 3)
    return direction / direction.norm(dim=-1, keepdim=True) * radius
