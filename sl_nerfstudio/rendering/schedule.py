"""What changes during training: sharpness of the surface and the levels of the grid."""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

_WIDTH_START, _WIDTH_END = 0.2, 0.02  # scene units: kernel width of the surface term over the run


@dataclass
class AnnealingConfig:
    """How sharpness and detail grow."""

    kappa_start: float = 32.0
    """Sharpness of the surface at the start, per scene unit."""
    kappa_end: float = 400.0
    """Sharpness at the end of the run, per scene unit."""
    kappa_growth: Literal["geometric", "linear"] = "geometric"
    """How kappa goes from start to end: `geometric` over the run's length, or `linear` by `kappa_per_step`."""
    kappa_per_step: float = 0.02
    """Increase of kappa in each step where growth is linear."""
    anneal_kappa: bool = True
    """Off: kappa has its end value throughout."""
    coarse_to_fine: bool = True
    """Fade in the grid's finer levels one after the other; off: use all levels from the first step."""
    levels_at_start: int = 2
    """Levels of the grid that are used from the first step."""
    all_levels_at: float = 0.4
    """Share of the run after which all levels have full weight."""


def kappa_at(config: AnnealingConfig, step: int, total: int) -> float:
    """Sharpness at a step."""
    if not config.anneal_kappa:
        return config.kappa_end
    if config.kappa_growth == "linear":
        return min(config.kappa_start + config.kappa_per_step * step, config.kappa_end)
    share = min(step / max(total, 1), 1.0)
    return config.kappa_start * math.exp(share * math.log(config.kappa_end / config.kappa_start))


def surface_width_at(step: int, total: int) -> float:
    """Width of the surface term's kernel at a step, scene units; see `surface_loss`."""
    share = min(step / max(total, 1), 1.0)
    return _WIDTH_START * (_WIDTH_END / _WIDTH_START) ** share


def level_weights_at(config: AnnealingConfig, levels: int, step: int, total: int) -> Float[Tensor, "levels"]:
    """Weight of each level at a step: finer ones fade in one after the other, each by a half cosine."""
    if not config.coarse_to_fine:
        return torch.ones(levels)
    late = max(levels - config.levels_at_start, 0)
    share = min(step / max(total * config.all_levels_at, 1e-9), 1.0) * late + config.levels_at_start
    ramp = (share - torch.arange(levels, dtype=torch.float64)).clamp(0, 1)
    return (0.5 - 0.5 * torch.cos(math.pi * ramp)).float()
