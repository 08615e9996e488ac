"""The losses of training, and what changes during it: sharpness of the surface and the levels of the grid.

Lengths are in scene units (the object's radius is 0.8), so nothing depends on the scan's unit.
"""

import math
from dataclasses import dataclass
from typing import Literal

import torch
import tyro
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass
class LossConfig:
    """Weights of the losses."""

    coordinates: float = 0.1
    """Weight of the rendered coordinates' L1 error, converted to a length by the scan's median depth sensitivity."""
    pattern: float = 0.005
    """Weight of the pattern term, 1 - cosine of rendered and captured intensities."""
    eikonal: float = 0.1
    """Weight of the Eikonal term, the mean squared difference between the field's slope and one."""
    surface: float = 1.0
    """Weight of the direct term |f| at triangulated points."""
    free_space: float = 1.0
    """Weight of the sign terms: positive in front of a triangulated point, negative just behind it."""
    coordinates_per_pixel: tyro.conf.Suppress[float | None] = None
    """Weight of the coordinates' L1 error in pattern pixels, used instead of `coordinates` by the paper's method."""

    @property
    def direct(self) -> bool:
        """Whether the terms on triangulated points have any weight."""
        return self.surface != 0 or self.free_space != 0


KappaGrowth = Literal["geometric", "linear", "constant"]

# Sharpness of the surface, per scene unit; `linear` is the paper's.
KAPPA_START, KAPPA_END = 32.0, 400.0
_LINEAR_KAPPA_END, _KAPPA_PER_STEP = 200.0, 0.02
LEVELS_AT_START = 2  # levels of the grid that are used from the first step
ALL_LEVELS_AT = 0.4  # share of the run after which all levels have full weight
_WIDTH_START, _WIDTH_END = 0.2, 0.02  # scene units: kernel width of the surface term over the run


@dataclass
class AnnealingConfig:
    """How sharpness and detail grow."""

    kappa: KappaGrowth = "geometric"
    """Sharpness of the surface: `geometric` growth over the run, `linear` with the steps (the paper's), or `constant`
    at its start value (the paper without annealing)."""
    coarse_to_fine: bool = True
    """Fade in the grid's finer levels one after the other; off: use all levels from the first step."""


def kappa_at(growth: KappaGrowth, step: int, total: int) -> float:
    """Sharpness at a step, per scene unit."""
    if growth == "constant":
        return KAPPA_START
    if growth == "linear":
        return min(KAPPA_START + _KAPPA_PER_STEP * step, _LINEAR_KAPPA_END)
    share = min(step / max(total, 1), 1.0)
    return KAPPA_START * math.exp(share * math.log(KAPPA_END / KAPPA_START))


def surface_width_at(step: int, total: int) -> float:
    """Width of the surface term's kernel at a step, scene units; see `surface_loss`."""
    share = min(step / max(total, 1), 1.0)
    return _WIDTH_START * (_WIDTH_END / _WIDTH_START) ** share


def level_weights_at(config: AnnealingConfig, levels: int, step: int, total: int) -> Float[Tensor, "levels"]:
    """Weight of each level at a step: finer ones fade in one after the other, each by a half cosine."""
    if not config.coarse_to_fine:
        return torch.ones(levels)
    late = max(levels - LEVELS_AT_START, 0)
    share = min(step / max(total * ALL_LEVELS_AT, 1e-9), 1.0) * late + LEVELS_AT_START
    ramp = (share - torch.arange(levels, dtype=torch.float64)).clamp(0, 1)
    return (0.5 - 0.5 * torch.cos(math.pi * ramp)).float()


LEAST_DESCENT = 0.05  # smallest cosine between ray and surface normal, for grazing rays


def _mean(values: Float[Tensor, "n"], counts: Bool[Tensor, "n"]) -> Float[Tensor, ""]:
    """Mean of the values that count; 0 if none does. A GPU need not tell the host how many they are."""
    return (values * counts).sum() / counts.sum().clamp_min(1)


def coordinate_loss(
    rendered: Float[Tensor, "rays 2"], measured: Float[Tensor, "rays 2"], counts: Bool[Tensor, "rays"]
) -> Float[Tensor, ""]:
    """Mean L1 distance, in pattern pixels, over the rays that count; 0 if none does.

    The paper, eq. 9: L1, because decoding errors are outliers.
    """
    return _mean((rendered - measured.nan_to_num()).abs().sum(-1), counts)


def pattern_loss(rendered: Float[Tensor, "rays"], measured: Float[Tensor, "rays"]) -> Float[Tensor, ""]:
    """1 - cosine between rendered and captured intensities of a batch, which match only up to scale."""
    return 1 - torch.nn.functional.cosine_similarity(rendered, measured, dim=0, eps=1e-6)


def eikonal_loss(gradient: Float[Tensor, "n 3"], counts: Bool[Tensor, "n"]) -> Float[Tensor, ""]:
    """Mean of (|gradient| - 1)^2 over the points that count: a signed distance has slope one."""
    return _mean((gradient.norm(dim=-1) - 1) ** 2, counts)


def surface_loss(
    sdf: Float[Tensor, "n"], weight: Float[Tensor, "n"], width: Float[Tensor, ""] | float
) -> Float[Tensor, ""]:
    """Robust mean of |f| at points that were measured on the surface.

    Charbonnier, modified to `width * (1 - exp(-|f| / width))`: linear for errors well below `width`, insensitive
    to those far above, which are wrong decodings.
    """
    return (weight * width * (1 - torch.exp(-sdf.abs() / width))).sum() / weight.sum().clamp_min(1e-9)


def free_space_loss(
    sdf: Float[Tensor, "n"], at_least: Float[Tensor, "n"], counts: Bool[Tensor, "n"]
) -> Float[Tensor, ""]:
    """Mean amount by which the field is below `at_least` at points that a ray passed before it met the surface."""
    return _mean((at_least - sdf).clamp_min(0), counts)


def behind_loss(sdf: Float[Tensor, "n"], counts: Bool[Tensor, "n"]) -> Float[Tensor, ""]:
    """Mean of the field's positive part just behind the surface."""
    return _mean(sdf.clamp_min(0), counts)


def facing_loss(
    gradient: Float[Tensor, "n 3"], direction: Float[Tensor, "n 3"], weight: Float[Tensor, "n"]
) -> Float[Tensor, ""]:
    """Weighted mean by which the field rises along rays at points where they meet the surface.

    A camera sees surfaces only from outside. Without this term a narrow valley can become three sheets, the middle one
    inside out through the measured points: |f| and the Eikonal term do not prevent that.
    """
    rise = (gradient * direction).sum(-1)
    return (weight * (rise + LEAST_DESCENT).clamp_min(0)).sum() / weight.sum().clamp_min(1e-9)
