"""The feature grid in plain torch: the reference for tests of the fast versions, and the version that runs on GPUs."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sl_nerfstudio.field.hash_grid import PRIMES, GridLayout


def corner_rows(layout: GridLayout, level: int, cell: Int[Tensor, "n 3"]) -> Int[Tensor, "n 8"]:
    """Table rows of the eight corners of cells; x varies fastest."""
    corner = torch.arange(8, device=cell.device)
    offset = torch.stack([corner & 1, corner >> 1 & 1, corner >> 2 & 1], -1)
    x, y, z = (cell[:, None] + offset).unbind(-1)
    if layout.hashed[level]:
        row = (x * PRIMES[0] ^ y * PRIMES[1] ^ z * PRIMES[2]) & (layout.sizes[level] - 1)
    else:
        side = layout.resolutions[level] + 1
        row = x + side * (y + side * z)
    return row + layout.offsets[level]


def corner_weights(
    layout: GridLayout, level: int, p: Float[Tensor, "n 3"]
) -> tuple[Int[Tensor, "n 3"], Float[Tensor, "n 8"], Float[Tensor, "n 8 3"]]:
    """Cell of each point, the interpolation weights of its corners, and their derivatives with respect to `p`."""
    half = layout.resolutions[level] / 2
    x = (p + 1) * half
    cell = x.detach().nan_to_num(0).floor().clamp(0, layout.resolutions[level] - 1)
    t = x - cell
    slope = torch.full_like(t, half)
    if layout.smooth:
        t, slope = t * t * (3 - 2 * t), slope * (6 * t * (1 - t))
    pair = torch.stack([1 - t, t], -1)  # [n, axis, side]
    step = torch.stack([-slope, slope], -1)

    def product(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        return (z[:, :, None, None] * y[:, None, :, None] * x[:, None, None, :]).flatten(1)

    (px, py, pz), (sx, sy, sz) = pair.unbind(1), step.unbind(1)
    derivative = torch.stack([product(sx, py, pz), product(px, sy, pz), product(px, py, sz)], -1)
    return cell.long(), product(px, py, pz), derivative


def encode(
    layout: GridLayout, table: Float[Tensor, "rows f"], level_weights: Float[Tensor, "levels"], p: Float[Tensor, "n 3"]
) -> Float[Tensor, "n width"]:
    """Level-weighted features of points in [-1, 1]^3; differentiable (also twice) by torch itself."""
    features = []
    for level in range(layout.levels):
        cell, weight, _ = corner_weights(layout, level, p)
        rows = table[corner_rows(layout, level, cell)]
        features.append((weight[..., None] * rows).sum(1) * level_weights[level])
    return torch.cat(features, -1)
