"""The losses of training.

Lengths are in scene units (the object's radius is about one), so nothing depends on the scan's unit.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

_LEAST_DESCENT = 0.05  # smallest cosine between ray and surface normal, for grazing rays


def coordinate_loss(
    rendered: Float[Tensor, "rays 2"], measured: Float[Tensor, "rays 2"], counts: Bool[Tensor, "rays"]
) -> Float[Tensor, ""]:
    """Mean L1 distance, in pattern pixels, over the rays that count; 0 if none does.

    The paper, eq. 9: L1, because decoding errors are outliers.
    """
    difference = (rendered - measured.nan_to_num()).abs().sum(-1)
    return (difference * counts).sum() / counts.sum().clamp_min(1)


def pattern_loss(rendered: Float[Tensor, "rays"], measured: Float[Tensor, "rays"]) -> Float[Tensor, ""]:
    """1 - cosine between rendered and captured intensities of a batch, which match only up to scale."""
    return 1 - torch.nn.functional.cosine_similarity(rendered, measured, dim=0, eps=1e-6)


def _mean(values: Float[Tensor, "n"], counts: Bool[Tensor, "n"]) -> Float[Tensor, ""]:
    """Mean of the values that count; 0 if none does. A GPU need not tell the host how many they are."""
    return (values * counts).sum() / counts.sum().clamp_min(1)


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
    return (weight * (rise + _LEAST_DESCENT).clamp_min(0)).sum() / weight.sum().clamp_min(1e-9)
