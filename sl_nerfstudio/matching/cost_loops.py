"""Loops of matching costs, each over so few arrays that the compiler makes it work on several numbers at a time."""

import numpy as np
from numpy import ndarray

from sl_nerfstudio.compiled import compiled

_HALF = 127  # the cost where image and pattern have nothing to do with each other
OUTSIDE = 255  # the cost beside the pattern


@compiled
def sample(picture: ndarray, x: ndarray, y: ndarray, out: ndarray) -> None:
    """The picture at columns x and rows y, bilinear; beside it as at its border."""
    pixels, width, zero = picture.ravel(), picture.shape[1], np.float32(0)
    right, lower = picture.shape[1] - 1, picture.shape[0] - 1
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            u = min(max(zero, x[row, column]), np.float32(right))
            v = min(max(zero, y[row, column]), np.float32(lower))
            i, j = min(np.int32(u), right - 1), min(np.int32(v), lower - 1)
            place, a, b = j * width + i, u - np.float32(i), v - np.float32(j)
            above = pixels[place] + a * (pixels[place + 1] - pixels[place])
            place += width
            below = pixels[place] + a * (pixels[place + 1] - pixels[place])
            out[row, column] = above + b * (below - above)


@compiled
def fill_costs(
    drawn: ndarray, image: ndarray, mean: ndarray, scale: ndarray, weights: ndarray, least: float, out: ndarray
) -> None:
    """Costs of a picture that was drawn for an image with known mean and inverse standard deviation in each window.

    Row by row, so that all that is needed on the way stays in the processor's nearest memory.
    """
    h, w = image.shape
    sums, longer = np.empty((3, w), dtype=np.float32), np.empty(w + 2 * (len(weights) - 1), dtype=np.float32)
    for row in range(h):
        _sum_down(drawn, image, row, weights, sums)
        for n in range(3):
            _sum_along(sums[n], weights, longer)
        _write_costs(sums[0], sums[1], sums[2], mean[row], scale[row], least, out[row])


@compiled
def _sum_down(drawn: ndarray, image: ndarray, row: int, weights: ndarray, out: ndarray) -> None:
    """Sums over the window's rows: of the pattern, of its square, and of its product with the image."""
    h, w = image.shape
    reach = len(weights) - 1
    out[:] = 0
    p, pp, ip = out[0], out[1], out[2]
    for k in range(-reach, reach + 1):
        there = row + k
        there = -1 - there if there < 0 else 2 * h - 1 - there if there >= h else there  # reflected at the border
        weight, a, b = weights[abs(k)], drawn[min(max(there, 0), h - 1)], image[min(max(there, 0), h - 1)]
        for column in range(w):
            p[column] += weight * a[column]
            pp[column] += weight * a[column] * a[column]
        for column in range(w):
            ip[column] += weight * a[column] * b[column]


@compiled
def _sum_along(row: ndarray, weights: ndarray, longer: ndarray) -> None:
    """Sums over the window's columns, in place. `longer` is room for the row, reflected at both ends."""
    w, reach = len(row), len(weights) - 1
    longer[reach : reach + w] = row
    for k in range(reach):
        longer[reach - 1 - k], longer[reach + w + k] = row[min(k, w - 1)], row[w - 1 - min(k, w - 1)]
    for column in range(w):
        row[column] *= weights[0]
    for k in range(1, reach + 1):
        weight, left, right = weights[k], longer[reach - k :], longer[reach + k :]
        for column in range(w):
            row[column] += weight * (left[column] + right[column])


@compiled
def _write_costs(
    p: ndarray, pp: ndarray, ip: ndarray, mean: ndarray, scale: ndarray, least: float, out: ndarray
) -> None:
    half, one = np.float32(_HALF), np.float32(1)
    for column in range(len(out)):
        m = p[column]
        spread = max(pp[column] - m * m, np.float32(0)) + least
        correlation = (ip[column] - m * mean[column]) * scale[column] / np.sqrt(spread)
        out[column] = np.uint8(min(max(half * (one - correlation), np.float32(0)), 2 * half))


@compiled
def mark_outside(x: ndarray, y: ndarray, size: tuple[int, int], out: ndarray) -> None:
    """The cost beside the picture, where columns x and rows y are."""
    half, right, lower = np.float32(0.5), np.float32(size[1] - 0.5), np.float32(size[0] - 0.5)
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            u, v = x[row, column], y[row, column]
            inside = (u >= -half) & (v >= -half) & (u <= right) & (v <= lower)
            out[row, column] = out[row, column] if inside else np.uint8(OUTSIDE)


@compiled
def interleave(block: ndarray, first: int, out: ndarray) -> None:
    """Several images of costs into the volume: one at a time, each pixel would be a place of its own in memory."""
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            for k in range(len(block)):
                out[row, column, first + k] = block[k, row, column]
