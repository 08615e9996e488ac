"""The order of the unknowns: frame by frame (delta, then rho of each), or delta of all frames, then rho of all."""

import torch
from jaxtyping import Float, Shaped
from torch import Tensor


def by_frame(values: Shaped[Tensor, "unknowns *k"]) -> Shaped[Tensor, "frames 12 *k"]:
    """From delta of all frames, then rho of all."""
    n = len(values) // 12
    return values.reshape(2, n, 6, *values.shape[1:]).transpose(0, 1).reshape(n, 12, *values.shape[1:])


def by_kind(values: Shaped[Tensor, "frames 12 *k"]) -> Shaped[Tensor, "unknowns *k"]:
    """The inverse of `by_frame`."""
    n = len(values)
    return values.reshape(n, 2, 6, *values.shape[2:]).transpose(0, 1).reshape(12 * n, *values.shape[2:])


def matrix_by_kind(matrix: Float[Tensor, "unknowns unknowns"], frames: int) -> Float[Tensor, "unknowns unknowns"]:
    """Rows and columns reordered as by `by_kind`; those after the frames' unknowns stay where they are."""
    order = torch.arange(len(matrix))
    order[: 12 * frames] = by_kind(order[: 12 * frames].reshape(frames, 12))
    return matrix[order][:, order]
