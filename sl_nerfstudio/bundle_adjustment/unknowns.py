"""The order of the unknowns: frame by frame (delta, then rho of each), or delta of all frames, then rho of all."""

from jaxtyping import Shaped
from torch import Tensor


def by_frame(values: Shaped[Tensor, "unknowns *k"]) -> Shaped[Tensor, "frames 12 *k"]:
    """From delta of all frames, then rho of all."""
    n = len(values) // 12
    return values.reshape(2, n, 6, *values.shape[1:]).transpose(0, 1).reshape(n, 12, *values.shape[1:])


def by_kind(values: Shaped[Tensor, "frames 12 *k"]) -> Shaped[Tensor, "unknowns *k"]:
    """The inverse of `by_frame`."""
    n = len(values)
    return values.reshape(n, 2, 6, *values.shape[2:]).transpose(0, 1).reshape(12 * n, *values.shape[2:])
