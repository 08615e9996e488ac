"""Paraboloids fitted to small windows of a coordinate image, in compiled loops.

A fit belongs to the pixel at the window's centre and serves every position within that pixel. Positions that stay in
their pixel need no new fit: a `WindowMemory` keeps the last one of each position.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from sl_nerfstudio.compiled import compiled, compiled_range


@dataclass(frozen=True)
class WindowMemory:
    """The last fit of each of some positions; a look-up changes it, and its result does not depend on it."""

    pixel: Int64[ndarray, "n"]  # number of the pixel among those of all frames; -1 for none
    fit: Float64[ndarray, "n 6 2"]  # c0 + cx dx + cy dy + cxx dx^2 + cxy dx dy + cyy dy^2 around the pixel's centre
    roughness: Float64[ndarray, "n"]  # RMS distance of the window from it; infinite without a fit

    @staticmethod
    def empty(count: int) -> "WindowMemory":
        """Without any fit."""
        return WindowMemory(np.full(count, -1), np.zeros((count, 6, 2)), np.full(count, np.inf))


@compiled_range
def look_up_windows(first, last, values, offsets, widths, heights, frame, uv, limits, memory, found, roughness):
    """Value and derivatives by x and y (`found`, 3 x 2) of the paraboloid at each position.

    `limits` are half the window, its fewest pixels and the least pivot; `memory` the three arrays of a WindowMemory.
    Where there is no fit, `roughness` is infinite.
    """
    pixels, fits, rough = memory
    A, right = np.zeros((6, 8)), np.zeros((6, 2))
    for k in range(first, last):
        f, px, py = frame[k], uv[k, 0], uv[k, 1]
        roughness[k] = np.inf
        if not (px >= 0 and py >= 0 and px < widths[f] and py < heights[f]):
            continue
        column, row = int(px), int(py)
        pixel = offsets[f] + row * widths[f] + column
        if pixels[k] != pixel:
            rough[k] = _fit(values, offsets[f], widths[f], heights[f], column, row, limits, A, right)
            pixels[k] = pixel
            for i in range(6):
                fits[k, i, 0], fits[k, i, 1] = A[i, 6], A[i, 7]
        roughness[k] = rough[k]
        if rough[k] < np.inf:
            dx, dy = px - column - 0.5, py - row - 0.5
            for c in range(2):
                c0, cx, cy = fits[k, 0, c], fits[k, 1, c], fits[k, 2, c]
                cxx, cxy, cyy = fits[k, 3, c], fits[k, 4, c], fits[k, 5, c]
                found[k, 0, c] = c0 + (cx + cxx * dx + cxy * dy) * dx + (cy + cyy * dy) * dy
                found[k, 1, c] = cx + 2 * cxx * dx + cxy * dy
                found[k, 2, c] = cy + cxy * dx + 2 * cyy * dy


@compiled
def _fit(values, offset, w, h, column, row, limits, A, right):
    """Least squares over one window: the coefficients in A[:, 6:], and the RMS distance (infinite without a fit).

    All products of the basis are monomials up to the fourth degree: their sums over a row come first.
    """
    half_window, least_pixels, least_pivot = limits
    A[:] = 0.0
    n = squares = origin_a = origin_b = 0.0
    for y in range(max(row - half_window, 0), min(row + half_window + 1, h)):
        s0 = s1 = s2 = s3 = s4 = a0 = a1 = a2 = b0 = b1 = b2 = 0.0
        for x in range(max(column - half_window, 0), min(column + half_window + 1, w)):
            pixel = offset + y * w + x
            a, b = float(values[pixel, 0]), float(values[pixel, 1])
            if not (np.isfinite(a) and np.isfinite(b)):
                continue
            if n == 0.0:
                origin_a, origin_b = a, b  # keeps the sums small
            n += 1.0
            a, b, d = a - origin_a, b - origin_b, float(x - column)
            d2 = d * d
            s0 += 1.0
            s1 += d
            s2 += d2
            s3 += d2 * d
            s4 += d2 * d2
            a0 += a
            a1 += a * d
            a2 += a * d2
            b0 += b
            b1 += b * d
            b2 += b * d2
            squares += a * a + b * b
        e = float(y - row)
        e2 = e * e
        A[0, 0] += s0
        A[1, 0] += s1
        A[2, 0] += e * s0
        A[3, 0] += s2
        A[4, 0] += e * s1
        A[5, 0] += e2 * s0
        A[3, 1] += s3
        A[4, 1] += e * s2
        A[5, 1] += e2 * s1
        A[5, 2] += e2 * e * s0
        A[3, 3] += s4
        A[4, 3] += e * s3
        A[4, 4] += e2 * s2
        A[5, 4] += e2 * e * s1
        A[5, 5] += e2 * e2 * s0
        for c, v0, v1, v2 in ((6, a0, a1, a2), (7, b0, b1, b2)):
            A[0, c] += v0
            A[1, c] += v1
            A[2, c] += e * v0
            A[3, c] += v2
            A[4, c] += e * v1
            A[5, c] += e2 * v0
    if n < least_pixels:
        return np.inf
    A[1, 1], A[2, 1], A[2, 2], A[3, 2], A[4, 2], A[5, 3] = A[3, 0], A[4, 0], A[5, 0], A[4, 1], A[5, 1], A[4, 4]
    for i in range(6):
        right[i, 0], right[i, 1] = A[i, 6], A[i, 7]
    if not _solve(A, least_pivot):
        return np.inf
    for i in range(6):
        squares -= A[i, 6] * right[i, 0] + A[i, 7] * right[i, 1]
    A[0, 6] += origin_a
    A[0, 7] += origin_b
    return np.sqrt(max(squares, 0.0) / n)


@compiled
def _solve(A, least_pivot):
    """Cholesky of the lower triangle of A[:, :6], then A[:, 6:] <- solution. False where the window is degenerate."""
    for j in range(6):
        d = A[j, j]
        scale = d
        for i in range(j):
            d -= A[j, i] * A[j, i]
        if not d > least_pivot * scale:
            return False
        A[j, j] = np.sqrt(d)
        for i in range(j + 1, 6):
            v = A[i, j]
            for m in range(j):
                v -= A[i, m] * A[j, m]
            A[i, j] = v / A[j, j]
    for c in range(6, 8):
        for i in range(6):
            v = A[i, c]
            for m in range(i):
                v -= A[i, m] * A[m, c]
            A[i, c] = v / A[i, i]
        for i in range(5, -1, -1):
            v = A[i, c]
            for m in range(i + 1, 6):
                v -= A[m, i] * A[m, c]
            A[i, c] = v / A[i, i]
    return True
