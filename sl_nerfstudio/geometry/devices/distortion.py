"""Lens distortion as OpenCV defines it: radial k1, k2 and tangential p1, p2, on normalised coordinates.

`distort` and `distortion_jacobian` are plain arithmetic, so they work on tensors and, compiled, on single numbers.
"""

from typing import Any

import torch
from torch import Tensor

Number = Any  # a tensor, or a float in compiled loops
UNDISTORT_STEPS, LEAST_DETERMINANT = 12, 1e-9


def distort(x: Number, y: Number, k1: Number, k2: Number, p1: Number, p2: Number) -> tuple[Number, Number]:
    """Distorted normalised coordinates, from ideal ones."""
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * k2)
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return xd, yd


def distortion_jacobian(
    x: Number, y: Number, k1: Number, k2: Number, p1: Number, p2: Number
) -> tuple[Number, Number, Number]:
    """d(xd)/dx, d(xd)/dy = d(yd)/dx, d(yd)/dy; the matrix is symmetric."""
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * k2)
    slope = 2 * k1 + 4 * k2 * r2
    a = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
    b = x * y * slope + 2 * p1 * x + 2 * p2 * y
    d = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
    return a, b, d


def undistort(
    xd: Tensor, yd: Tensor, k1: Tensor, k2: Tensor, p1: Tensor, p2: Tensor, iterations: int = UNDISTORT_STEPS
) -> tuple[Tensor, Tensor]:
    """Ideal normalised coordinates, from distorted ones: Newton's method, started at the distorted point."""
    x, y = xd, yd
    for _ in range(iterations):
        ex, ey = distort(x, y, k1, k2, p1, p2)
        ex, ey = ex - xd, ey - yd
        a, b, d = distortion_jacobian(x, y, k1, k2, p1, p2)
        det = a * d - b * b
        det = torch.where(det.abs() < LEAST_DETERMINANT, torch.full_like(det, LEAST_DETERMINANT), det)
        x = x - (d * ex - b * ey) / det
        y = y - (a * ey - b * ex) / det
    return x, y
