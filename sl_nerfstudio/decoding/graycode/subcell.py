"""Coordinates finer than the cells of a Gray code.

Between two neighbouring cells exactly one bit changes, and the difference of its image and its inverse is zero exactly
on the border, whatever albedo and shading are. So borders are found to a fraction of a camera pixel, and a plane
through the borders around a pixel gives its coordinate.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int8, Int16, Int32
from numpy import ndarray

from sl_nerfstudio.compiled import compiled
from sl_nerfstudio.geometry.plane_fit import solve_plane

LEVELS = 3  # a pixel is used if fewer of its finest bits than this are uncertain
# The plane through the borders around a pixel.
_LEAST_BORDERS = 4
_SMALLEST_WINDOW, _LARGEST_WINDOW = 2, 10  # pixels to each side
_INLIER = 0.5  # cells from the plane
_MISREAD = 1.0  # cells: a pixel whose own cell is farther than this from the plane was misread


@dataclass(frozen=True)
class Cells:
    """The cells of all pixels along one axis."""

    cell: Int32[ndarray, "h w"]  # index of the cell; its last `level` bits are uncertain
    level: Int8[ndarray, "h w"]  # number of the finest bits that are uncertain; -1: the cell is unknown
    difference: Int16[ndarray, "bits h w"]  # image minus inverse of every bit, coarse to fine


def subcell_coordinates(cells: Cells, count: int) -> Float32[ndarray, "h w"]:
    """Coordinate of every pixel in cells, of which there are `count`; NaN where it is unknown.

    The first cell extends from 0 to 1. Where stripes are out of focus, the borders of coarser bits are used. Where
    there are too few borders, the mean of the cells around a pixel is used instead.
    """
    right, down = _borders(cells.cell, cells.level, cells.difference)
    pixels, borders = int((cells.level >= 0).sum()), int((right >= 0).sum() + (down >= 0).sum())
    pitch = pixels / max(borders, 1)  # pixels from border to border
    half = int(np.clip(np.ceil(1.2 * pitch), _SMALLEST_WINDOW, _LARGEST_WINDOW))
    out = np.full(cells.cell.shape, np.nan, dtype=np.float32)
    _fit(cells.cell, cells.level, right, down, half, 2 * half / max(pitch, 0.5) + 2, out)
    return np.clip(out, 0, count)


@compiled
def _borders(cell: ndarray, level: ndarray, difference: ndarray) -> tuple[ndarray, ndarray]:
    """Position of a border between a pixel's centre (0) and that of its right or lower neighbour (1); -1: none."""
    bits, h, w = difference.shape
    right = np.full((h, w), np.float32(-1))
    down = np.full((h, w), np.float32(-1))
    for y in range(h):
        for x in range(w):
            if level[y, x] < 0:
                continue
            for step in range(2):
                v, u = y + step, x + 1 - step
                if v >= h or u >= w or level[v, u] < 0:
                    continue
                common = max(level[y, x], level[v, u])
                a, b = cell[y, x] >> common, cell[v, u] >> common
                if abs(a - b) != 1:
                    continue
                flipped = (a ^ (a >> 1)) ^ (b ^ (b >> 1))
                bit = bits - 1 - common
                while flipped > 1:
                    flipped >>= 1
                    bit -= 1
                here, there = float(difference[bit, y, x]), float(difference[bit, v, u])
                if (here > 0) == (there > 0):
                    continue
                place = np.float32(here / (here - there))
                if step == 0:
                    right[y, x] = place
                else:
                    down[y, x] = place
    return right, down


@compiled
def _fit(cell: ndarray, level: ndarray, right: ndarray, down: ndarray, half: int, reach: float, out: ndarray) -> None:
    h, w = cell.shape
    for y in range(h):
        for x in range(w):
            if level[y, x] < 0:
                continue
            block = 1 << level[y, x]
            own = ((cell[y, x] >> level[y, x]) + 0.5) * block
            found, value, sx, sy = _plane(cell, level, right, down, y, x, half, reach, (own, 0.0, 0.0), np.inf)
            if found:  # once more, without borders far from the first plane
                found, value, sx, sy = _plane(cell, level, right, down, y, x, half, reach, (value, sx, sy), _INLIER)
            if not found:
                if block > 1:
                    continue
                value = _mean_cell(cell, level, y, x, half, reach)
            if abs(value - own) <= block / 2 + _MISREAD:
                out[y, x] = value


@compiled
def _plane(cell, level, right, down, y, x, half, reach, near, tolerance):
    """The plane through the borders around a pixel: whether it exists, its value at the pixel, its slopes in x and y.

    Borders farther than `tolerance` from the plane `near` (value and slopes) are ignored.
    """
    h, w = cell.shape
    centre, ox, oy = near
    n = sx = sy = sxx = sxy = syy = s = sxs = sys = 0.0
    for v in range(max(y - half, 0), min(y + half + 1, h)):
        for u in range(max(x - half, 0), min(x + half + 1, w)):
            if level[v, u] < 0 or abs(cell[v, u] + 0.5 - centre) > reach:
                continue
            for step in range(2):
                place = right[v, u] if step == 0 else down[v, u]
                if place < 0:
                    continue
                common = max(level[v, u], level[v + step, u + 1 - step])
                border = max(cell[v, u] >> common, cell[v + step, u + 1 - step] >> common) << common
                value = border - centre
                dx = u - x + (place if step == 0 else 0.0)
                dy = v - y + (place if step == 1 else 0.0)
                if abs(value - ox * dx - oy * dy) > tolerance:
                    continue
                n += 1.0
                sx += dx
                sy += dy
                sxx += dx * dx
                sxy += dx * dy
                syy += dy * dy
                s += value
                sxs += dx * value
                sys += dy * value
    if n < _LEAST_BORDERS:
        return False, centre, 0.0, 0.0
    solvable, value, fx, fy = solve_plane(n, sx, sy, sxx, sxy, syy, s, sxs, sys, 1e-2 * n * n * n)
    if not solvable:
        return False, centre, 0.0, 0.0
    return True, centre + value, fx, fy


@compiled
def _mean_cell(cell, level, y, x, half, reach):
    """Mean of the cells' centres in a window that is symmetric about the pixel."""
    h, w = cell.shape
    total = count = 0.0
    own = cell[y, x]
    for v in range(max(y - half, 0), min(y + half + 1, h)):
        for u in range(max(x - half, 0), min(x + half + 1, w)):
            mv, mu = 2 * y - v, 2 * x - u
            if not (0 <= mv < h and 0 <= mu < w) or level[v, u] != 0 or level[mv, mu] != 0:
                continue
            if abs(cell[v, u] - own) <= reach and abs(cell[mv, mu] - own) <= reach:
                total += cell[v, u] + 0.5
                count += 1.0
    return total / count
