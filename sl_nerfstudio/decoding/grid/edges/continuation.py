"""Coordinates continued as a plane from a place some pixels away.

The displacement of a pixel to a place on the same surface that is farther from its edge follows Ramamonjisoa et al.,
"Predicting sharp and accurate occlusion boundaries in monocular depth estimation using displacement fields" (2020);
here the plane at that place is continued, not its value.
"""

import numpy as np
from jaxtyping import Float32, Int
from numpy import ndarray

from sl_nerfstudio.compiled import compiled
from sl_nerfstudio.pattern.gaussian_window import gaussian_window

_DISTANCES = (3, 6, 9, 13)  # pixels of the rectified image
_DIRECTIONS = 8
_TEAR = 0.3  # periods between neighbouring pixels: a larger difference is no slope
_LEAST_SEEN = 1e-3  # share of the window in which there is a slope
_SLOPE_WINDOW = 2.0  # sigma, pixels of the rectified image


def steps(distances: tuple[int, ...] = _DISTANCES) -> Int[ndarray, "k 2"]:
    """Steps (x, y) from a pixel to the places that it may be continued from; the first is the pixel itself."""
    angle = 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    around = np.stack([np.cos(angle), np.sin(angle)], -1)
    return np.rint(np.concatenate([[(0.0, 0.0)], *[r * around for r in distances]])).astype(np.int64)


def slopes(coords: Float32[ndarray, "h w 2"], period: float, scale: float = 1.0) -> Float32[ndarray, "h w 2 2"]:
    """Derivatives of coordinates (x, y) by pixels (x, y), means over a small window; NaN where there are none.

    `period` is in the unit of the coordinates; `scale` is the size of a pixel of the rectified image in pixels of this
    one.
    """
    total = np.empty((*coords.shape, 2), dtype=np.float32)
    count = np.empty(coords.shape, dtype=np.float32)
    _sum_steps(coords, np.float32(_TEAR * period), total, count)
    out = gaussian_window(total.reshape(*coords.shape[:2], 4), _SLOPE_WINDOW * scale).reshape(total.shape)
    _divide(out, gaussian_window(count, _SLOPE_WINDOW * scale))
    return out


@compiled
def _sum_steps(coords: ndarray, tear: float, total: ndarray, count: ndarray) -> None:
    """Sums (axis, by x or y) of the steps to the neighbours on both sides that are not torn away, and their number."""
    h, w = coords.shape[:2]
    for row in range(h):
        for column in range(w):
            for by in range(2):
                x = y = np.float32(0)
                smooth = 0
                for side in range(2):  # the step to the next pixel, then the one from the pixel before
                    r, c = row - side * by, column - side * (1 - by)
                    rr, cc = r + by, c + 1 - by
                    if r < 0 or c < 0 or rr >= h or cc >= w:
                        continue
                    dx, dy = coords[rr, cc, 0] - coords[r, c, 0], coords[rr, cc, 1] - coords[r, c, 1]
                    if abs(dx) < tear and abs(dy) < tear:  # False for NaN
                        x, y, smooth = x + dx, y + dy, smooth + 1
                total[row, column, 0, by], total[row, column, 1, by], count[row, column, by] = x, y, smooth


@compiled
def _divide(total: ndarray, count: ndarray) -> None:
    """Means from sums, in place; NaN where hardly anything was added up."""
    h, w = count.shape[:2]
    for row in range(h):
        for column in range(w):
            for by in range(2):
                n = count[row, column, by]
                for axis in range(2):
                    total[row, column, axis, by] = total[row, column, axis, by] / n if n > _LEAST_SEEN else np.nan


def continued(
    coords: Float32[ndarray, "h w 2"],
    slope: Float32[ndarray, "h w 2 2"],
    step: Int[ndarray, "h w 2"],
) -> Float32[ndarray, "h w 2"]:
    """Coordinates at each pixel on the plane at the place `step` pixels (x, y) away; NaN where nothing is known there.

    A pixel whose step is zero keeps its coordinates.
    """
    out = np.empty_like(coords)
    _continue(coords, slope, step, out)
    return out


@compiled
def _continue(coords: ndarray, slope: ndarray, step: ndarray, out: ndarray) -> None:
    h, w = coords.shape[:2]
    for row in range(h):
        for column in range(w):
            dx, dy = step[row, column, 0], step[row, column, 1]
            r, c = row + dy, column + dx
            for axis in range(2):
                if dx == 0 and dy == 0:
                    out[row, column, axis] = coords[row, column, axis]
                elif 0 <= r < h and 0 <= c < w:
                    out[row, column, axis] = coords[r, c, axis] - slope[r, c, axis, 0] * dx - slope[r, c, axis, 1] * dy
                else:
                    out[row, column, axis] = np.nan
