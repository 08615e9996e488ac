"""Never worse: refined poses are kept only if pixels that took no part in refining them agree better."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.observations import observe
from sl_nerfstudio.bundle_adjustment.residuals import Anchors, Observations, Rig, residuals_of
from sl_nerfstudio.geometry.devices import unproject
from sl_nerfstudio.geometry.triangulation import closest_approach

_FRAMES_PER_ANCHOR = 8
_ROUNDING = 1e-6  # a smaller gain is none


@dataclass(frozen=True)
class HeldOutPixels:
    """Decoded pixels that the adjustment never saw."""

    frame: Int[Tensor, "n"]
    uv_camera: Float[Tensor, "n 2"]
    uv_projector: Float[Tensor, "n 2"]


@dataclass(frozen=True)
class CrossValidation:
    """Robust mean residual of held-out pixels, in projector pixels, before and after."""

    before_px: float
    after_px: float

    @property
    def better(self) -> bool:
        """Whether the refined poses are to be kept."""
        return self.after_px < (1 - _ROUNDING) * self.before_px


def cross_validate(
    before: Rig, after: Rig, held_out: HeldOutPixels, maps: CoordinateMaps, width_px: float
) -> CrossValidation:
    """Judge two sets of poses by the same pixels and the same pairs of frames.

    A residual counts as sqrt(r^2 / (1 + r^2 / width^2)): a wrong decoding costs `width_px` whatever the poses.
    """
    generator = torch.Generator().manual_seed(0)
    pairs = []
    for rig in (before, after):
        seen = observe(rig, _anchors(rig, held_out), maps, _FRAMES_PER_ANCHOR, 2 * width_px, generator)
        pairs.append(torch.stack([seen.anchor, seen.frame]))
    rows = torch.unique(torch.cat(pairs, 1), dim=1)
    observations = Observations(rows[0], rows[1])
    return CrossValidation(*(_mean_residual(rig, held_out, observations, maps, width_px) for rig in (before, after)))


def _mean_residual(rig: Rig, held_out: HeldOutPixels, rows: Observations, maps: CoordinateMaps, width: float) -> float:
    r = residuals_of(rig, _anchors(rig, held_out), rows, maps)
    own2 = torch.nan_to_num((r.own**2).sum(-1), nan=float("inf"))
    cross2 = torch.where(r.cross_valid, (r.cross**2).sum(-1), torch.full_like(r.cross[:, 0], float("inf")))
    r2 = torch.cat([own2, torch.nan_to_num(cross2, nan=float("inf"))])
    return float((1 / (1 / r2.clamp_min(1e-12) + 1 / width**2)).mean().sqrt())


def _anchors(rig: Rig, held_out: HeldOutPixels) -> Anchors:
    d_camera = unproject(rig.camera[held_out.frame], held_out.uv_camera)
    T = rig.T_camera_projector[held_out.frame]
    d_projector = (T[:, :3, :3] @ unproject(rig.projector, held_out.uv_projector)[..., None]).squeeze(-1)
    depth, _ = closest_approach(torch.zeros_like(d_camera), d_camera, T[:, :3, 3], d_projector)
    # no map around a held-out pixel, so no normal: towards the camera is near enough to choose who else sees it
    return Anchors(held_out.frame, d_camera, held_out.uv_projector, torch.nan_to_num(depth, nan=1.0), -d_camera)
