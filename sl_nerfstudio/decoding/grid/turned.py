"""Coordinates in the pattern as the camera sees it: turned by quarter turns until its lines are as in the image."""

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from sl_nerfstudio.pattern.grid import GridPattern


def to_pattern(turned: Float32[ndarray, "*n 2"], grid: GridPattern, turn: int) -> Float32[ndarray, "*n 2"]:
    """Pattern pixels of places (x, y), in periods, in the array of nodes after `turn` quarter turns."""
    x, y = turned[..., 0], turned[..., 1]
    i, j = (
        (y, x),
        (grid.rows - 1 - x, y),
        (grid.rows - 1 - y, grid.columns - 1 - x),
        (x, grid.columns - 1 - y),
    )[turn]
    return np.stack([grid.x0 + j * grid.period, grid.y0 + i * grid.period], -1).astype(np.float32)


def from_pattern(coords: Float32[ndarray, "*n 2"], grid: GridPattern, turn: int) -> Float32[ndarray, "*n 2"]:
    """The inverse of `to_pattern`."""
    j, i = (coords[..., 0] - grid.x0) / grid.period, (coords[..., 1] - grid.y0) / grid.period
    x, y = (
        (j, i),
        (grid.rows - 1 - i, j),
        (grid.columns - 1 - j, grid.rows - 1 - i),
        (i, grid.columns - 1 - j),
    )[turn]
    return np.stack([x, y], -1).astype(np.float32)
