"""Coordinates continued as a plane from a place some pixels away.

The displacement of a pixel to a place on the same surface that is farther from its edge follows Ramamonjisoa et al.,
"Predicting sharp and accurate occlusion boundaries in monocular depth estimation using displacement fields" (2020);
here the plane at that place is continued, not its value.
"""

import cv2
import numpy as np
from jaxtyping import Float32, Int
from numpy import ndarray

from sl_nerfstudio.compiled import compiled

_DISTANCES = (3, 6, 9, 13)  # pixels of the rectified image
_DIRECTIONS = 8
_TEAR = 0.3  # periods between neighbouring pixels: a larger difference is no slope
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
    total = np.zeros((*coords.shape, 2), dtype=np.float32)
    count = np.zeros(coords.shape, dtype=np.float32)
    for axis, by in ((1, 0), (0, 1)):
        step = np.diff(coords, axis=axis)
        smooth = np.abs(step).max(-1) < _TEAR * period  # False for NaN
        step = np.where(smooth[..., None], step, 0)
        for first in (0, 1):
            part = (slice(None),) * axis + (slice(first, first + step.shape[axis]),)
            total[part][..., by] += step
            count[part][..., by] += smooth
    total = _blurred(total.reshape(*coords.shape[:2], 4), scale).reshape(total.shape)
    count = _blurred(count, scale)[..., None, :]
    return np.where(count > 1e-3, total / np.maximum(count, 1e-6), np.float32(np.nan)).astype(np.float32)


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


def _blurred(values: Float32[ndarray, "h w k"], scale: float) -> Float32[ndarray, "h w k"]:
    return cv2.GaussianBlur(values, (0, 0), _SLOPE_WINDOW * scale, borderType=cv2.BORDER_CONSTANT)
