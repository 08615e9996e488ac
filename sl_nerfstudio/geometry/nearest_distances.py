"""How far from a device the nearest of many points are, on a lattice of its pixels: what is farther is hidden."""

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray
from scipy.ndimage import minimum_filter


def nearest_distances(
    cells: tuple[Int64[ndarray, "n"], Int64[ndarray, "n"]], distance: Float64[ndarray, "n"], shape: tuple[int, int]
) -> Float64[ndarray, "h w"]:
    """The least distance in each cell (row, column) and its eight neighbours; infinite where there is no point."""
    nearest = np.full(shape, np.inf)
    np.minimum.at(nearest, cells, distance)
    return minimum_filter(nearest, 3)
