"""Paraboloids fitted to small windows of a coordinate image, in compiled loops.

A fit belongs to the pixel at the window's centre and serves every position within that pixel. Positions that stay in
their pixel need no new fit: a `WindowMemory` keeps the last one of each position. Windows are fitted frame by frame: if
the images are in a file, each of them is read once.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from sl_nerfstudio.bundle_adjustment.loops.groups import Groups
from sl_nerfstudio.bundle_adjustment.loops.pixel_index import is_known, next_place, words_of
from sl_nerfstudio.compiled import compiled, compiled_range


@dataclass(frozen=True)
class WindowMemory:
    """The last fit of each of some positions; a look-up changes it, and its result does not depend on it."""

    order: Int64[ndarray, "n"]  # in which windows are fitted
    pixel: Int64[ndarray, "n"]  # number of the pixel in its frame; -1 outside, -2 before the first fit
    fit: Float64[ndarray, "n 6 2"]  # c0 + cx dx + cy dy + cxx dx^2 + cxy dx dy + cyy dy^2 around the pixel's centre
    roughness: Float64[ndarray, "n"]  # RMS distance of the window from it; infinite without a fit

    @staticmethod
    def empty(frame: Int64[ndarray, "n"]) -> "WindowMemory":
        """Without any fit, for positions in these frames."""
        count, frames = len(frame), int(frame.max(initial=-1)) + 1
        order = Groups.of(frame, frames).entries
        return WindowMemory(order, np.full(count, -2), np.zeros((count, 6, 2)), np.full(count, np.inf))


@compiled_range
def mark_moved(first, last, index, frame, uv, pixels, moved):
    """Pixel in which each position is now, -1 outside the image; whether it is another one than before."""
    _, _, widths, heights = index
    for k in range(first, last):
        f, x, y = frame[k], uv[k, 0], uv[k, 1]
        inside = x >= 0 and y >= 0 and x < widths[f] and y < heights[f]
        pixel = int(y) * widths[f] + int(x) if inside else -1
        moved[k] = pixel != pixels[k]
        pixels[k] = pixel


@compiled_range
def fit_windows(first, last, chosen, values, index, frame, pixels, limits, fits, roughness):
    """The paraboloids of some positions, in the order of their numbers in `chosen`.

    `limits` are half the window, its fewest pixels and the least pivot. Where there is no fit, `roughness` is infinite.
    """
    words, first_words, widths, heights = index
    A, right, places = np.zeros((6, 8)), np.zeros((6, 2)), np.zeros(2 * limits[0] + 1, dtype=np.int64)
    for k in chosen[first:last]:
        f, pixel = frame[k], pixels[k]
        roughness[k] = np.inf
        if pixel >= 0:
            w = widths[f]
            roughness[k] = _fit(
                values, words, first_words[f], w, heights[f], pixel % w, pixel // w, limits, places, A, right
            )
            for i in range(6):
                fits[k, i, 0], fits[k, i, 1] = A[i, 6], A[i, 7]


@compiled_range
def evaluate_windows(first, last, widths, frame, uv, pixels, fits, roughness, found):
    """Value and derivatives by x and y (`found`, 3 x 2) of the paraboloid at each position."""
    for k in range(first, last):
        if roughness[k] < np.inf:
            w = widths[frame[k]]
            dx, dy = uv[k, 0] - pixels[k] % w - 0.5, uv[k, 1] - pixels[k] // w - 0.5
            for c in range(2):
                c0, cx, cy = fits[k, 0, c], fits[k, 1, c], fits[k, 2, c]
                cxx, cxy, cyy = fits[k, 3, c], fits[k, 4, c], fits[k, 5, c]
                found[k, 0, c] = c0 + (cx + cxx * dx + cxy * dy) * dx + (cy + cyy * dy) * dy
                found[k, 1, c] = cx + 2 * cxx * dx + cxy * dy
                found[k, 2, c] = cy + cxy * dx + 2 * cyy * dy


@compiled
def _fit(values, words, first_word, w, h, column, row, limits, places, A, right):
    """Least squares over one window: the coefficients in A[:, 6:], and the RMS distance (infinite without a fit).

    All products of the basis are monomials up to the fourth degree: their sums over a row come first.
    """
    half_window, least_pixels, least_pivot = limits
    left, end = max(column - half_window, 0), min(column + half_window + 1, w)
    top, bottom = max(row - half_window, 0), min(row + half_window + 1, h)
    A[:] = 0.0
    n = squares = origin_a = origin_b = 0.0
    for y in range(top, bottom):  # all rows first: each waits for memory, and together they wait once
        places[y - top] = next_place(words, first_word + y * words_of(w), left)
    for y in range(top, bottom):
        s0 = s1 = s2 = s3 = s4 = a0 = a1 = a2 = b0 = b1 = b2 = 0.0
        row_word, place = first_word + y * words_of(w), places[y - top]
        for x in range(left, end):
            if not is_known(words, row_word, x):
                continue
            a, b = float(values[place, 0]), float(values[place, 1])
            place += 1
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
