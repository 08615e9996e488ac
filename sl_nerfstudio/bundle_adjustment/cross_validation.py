"""Are adjusted poses better? Pixels that took no part in the adjustment decide, by a paired comparison.

Each held-out pixel has the same residuals under both sets of poses. So the mean of their differences is compared with
zero, rather than two means with each other. Residuals within a small block of an image depend on each other: blocks are
the independent samples from which the standard error follows.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.observations import observe, partners
from sl_nerfstudio.bundle_adjustment.residuals import Anchors, Observations, residuals_of
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.bundle_adjustment.settings import AdjustmentSettings
from sl_nerfstudio.geometry.devices import unproject
from sl_nerfstudio.geometry.triangulation import closest_approach
from sl_nerfstudio.threads import one_library_thread


@dataclass(frozen=True)
class HeldOutPixels:
    """Decoded pixels that the adjustment never saw."""

    frame: Int[Tensor, "n"]
    uv_camera: Float[Tensor, "n 2"]
    uv_projector: Float[Tensor, "n 2"]
    block: Int[Tensor, "n"]  # number of the block of pixels, over all frames


@dataclass(frozen=True)
class CrossValidation:
    """How well held-out pixels agree with two sets of poses; robust residuals in projector pixels."""

    before_px: float  # robust RMS residual with the old poses
    after_px: float
    difference: float  # mean of the paired differences of squared robust residuals, after minus before, px^2
    standard_error: float  # of that mean; infinite for fewer than two blocks
    standard_errors: float  # by which the difference must be below zero
    least_gain: float  # share of the old poses' mean square by which it must be below zero as well

    @property
    def better(self) -> bool:
        """Whether to keep the new poses: they are better by more than chance, and by more than decoding is biased."""
        return self.difference < -self._margin

    @property
    def worse(self) -> bool:
        """The same the other way round."""
        return self.difference > self._margin

    @property
    def _margin(self) -> float:
        return max(self.standard_errors * self.standard_error, self.least_gain * self.before_px**2)


@one_library_thread()
def cross_validate(
    before: Rig,
    after: Rig,
    held_out: HeldOutPixels,
    maps: CoordinateMaps,
    noise_px: float,
    settings: AdjustmentSettings | None = None,
) -> CrossValidation:
    """Compare two sets of poses on the same pixels and the same pairs of frames.

    A residual counts as r^2 / (1 + r^2 / width^2): a wrong decoding costs width^2 with any poses. `noise_px` is the
    decoding noise of one look-up.
    """
    settings = settings or AdjustmentSettings()
    s = settings.cross_validation
    width = max(s.width_noises * noise_px, s.least_width_px)
    generator = torch.Generator().manual_seed(settings.seed)
    sides = [(rig, _anchors(rig, held_out)) for rig in (before, after)]
    together = partners(after, sides[1][1], maps, settings.partners, settings.least_cosine, generator)
    keys = []
    for rig, anchors in sides:
        seen = observe(rig, anchors, maps, s.frames_per_pixel, 2 * width, settings.least_cosine, generator, together)
        keys.append(seen.anchor * rig.frames + seen.frame)
    key = torch.unique(torch.cat(keys))
    rows = Observations(key // before.frames, key % before.frames)
    block = torch.cat([held_out.block, held_out.block[rows.anchor]])
    losses = [_robust_squares(rig, anchors, rows, maps, width) for rig, anchors in sides]
    difference, error = mean_and_error(losses[1] - losses[0], block)
    first, second = (float(loss.mean().sqrt()) for loss in losses)
    return CrossValidation(first, second, difference, error, s.standard_errors, s.least_gain)


def _robust_squares(
    rig: Rig, anchors: Anchors, rows: Observations, maps: CoordinateMaps, width: float
) -> Float[Tensor, "residuals"]:
    """Robust squares of the own residuals, then of the cross residuals; width^2 for those that do not exist."""
    r = residuals_of(rig, anchors, rows, maps)
    own2 = torch.nan_to_num((r.own**2).sum(-1), nan=float("inf"))
    cross2 = torch.where(r.cross_valid, (r.cross**2).sum(-1), torch.full_like(r.cross[:, 0], float("inf")))
    r2 = torch.cat([own2, torch.nan_to_num(cross2, nan=float("inf"))])
    return 1 / (1 / r2.clamp_min(1e-12) + 1 / width**2)


def mean_and_error(values: Float[Tensor, "n"], block: Int[Tensor, "n"]) -> tuple[float, float]:
    """Mean and its standard error, if the values within a block may depend on each other in any way.

    The error of a ratio of sums over blocks (Cochran, Sampling Techniques, 1977, section 6.3).
    """
    mean = values.mean()
    _, index = torch.unique(block, return_inverse=True)
    blocks = int(index.max()) + 1 if len(index) else 0
    if blocks < 2:
        return float(mean), float("inf")
    sums = torch.zeros(blocks, dtype=values.dtype).index_add(0, index, values - mean)
    return float(mean), float((blocks / (blocks - 1) * (sums**2).sum()).sqrt() / len(values))


def _anchors(rig: Rig, held_out: HeldOutPixels) -> Anchors:
    d_camera = unproject(rig.camera[held_out.frame], held_out.uv_camera)
    T = rig.T_camera_projector[held_out.frame]
    d_projector = (T[:, :3, :3] @ unproject(rig.projector, held_out.uv_projector)[..., None]).squeeze(-1)
    depth, _ = closest_approach(torch.zeros_like(d_camera), d_camera, T[:, :3, 3], d_projector)
    # No map surrounds a held-out pixel, so there is no normal; "towards the camera" is accurate enough to choose the
    # frames that see it.
    return Anchors(held_out.frame, d_camera, held_out.uv_projector, torch.nan_to_num(depth, nan=1.0), -d_camera)
