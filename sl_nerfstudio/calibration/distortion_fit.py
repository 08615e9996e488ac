"""Lens models with more terms than a scan has, reduced to k1, k2, p1, p2 where the difference is negligible."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

LARGEST_MISS_PX = 0.1  # of the reduced model against the full one, anywhere in the image
_SAMPLES = 41  # per side of the image
_ITERATIONS = 50  # of undistortion


def reduce_distortion(
    coefficients: Sequence[float], matrix: Float64[ndarray, "3 3"], size: tuple[int, int]
) -> tuple[tuple[float, float, float, float], float]:
    """(k1, k2, p1, p2) nearest to OpenCV's (k1, k2, p1, p2, k3, k4, k5, k6), and the largest difference in pixels.

    `matrix` holds focal lengths and principal point; `size` is (w, h). Four coefficients stay as they are.
    """
    full = np.zeros(8)
    full[: len(coefficients)] = coefficients
    if not full[4:].any():
        return (full[0], full[1], full[2], full[3]), 0.0
    x, y = _normalised_grid(full, matrix, size)
    xd, yd = _distort(x, y, full)
    r2 = x * x + y * y
    rows_x = np.stack([x * r2, x * r2 * r2, 2 * x * y, r2 + 2 * x * x], -1)
    rows_y = np.stack([y * r2, y * r2 * r2, r2 + 2 * y * y, 2 * x * y], -1)
    A = np.concatenate([matrix[0, 0] * rows_x, matrix[1, 1] * rows_y])
    b = np.concatenate([matrix[0, 0] * (xd - x), matrix[1, 1] * (yd - y)])
    k = np.linalg.lstsq(A, b, rcond=None)[0]
    miss = (A @ k - b).reshape(2, -1)
    return (float(k[0]), float(k[1]), float(k[2]), float(k[3])), float(np.hypot(*miss).max())


def _normalised_grid(
    full: Float64[ndarray, "8"], matrix: Float64[ndarray, "3 3"], size: tuple[int, int]
) -> tuple[Float64[ndarray, "n"], Float64[ndarray, "n"]]:
    """Undistorted normalised coordinates of a grid of pixels, by fixed-point iteration."""
    u, v = np.meshgrid(np.linspace(0, size[0], _SAMPLES), np.linspace(0, size[1], _SAMPLES))
    xd = (u.reshape(-1) - matrix[0, 2]) / matrix[0, 0]
    yd = (v.reshape(-1) - matrix[1, 2]) / matrix[1, 1]
    x, y = xd, yd
    for _ in range(_ITERATIONS):
        ex, ey = _distort(x, y, full)
        x, y = x - (ex - xd), y - (ey - yd)
    return x, y


def _distort(
    x: Float64[ndarray, "n"], y: Float64[ndarray, "n"], full: Float64[ndarray, "8"]
) -> tuple[Float64[ndarray, "n"], Float64[ndarray, "n"]]:
    k1, k2, p1, p2, k3, k4, k5, k6 = full
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return xd, yd
