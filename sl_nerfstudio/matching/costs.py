"""Matching costs of image and pattern: correlations in Gaussian windows, at every inverse distance that is tried.

Tiles that lie side by side and have about the same range are computed together, as a block with half a window around
it, one inverse distance after the other: all that is needed on the way stays in the processor's nearest memory.
"""

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8, UInt32
from numpy import ndarray

from sl_nerfstudio.decoding.decoder import Coords, Layer, Mask
from sl_nerfstudio.decoding.grid_fit import DrawnGrid
from sl_nerfstudio.matching.lines import EpipolarLines, places_on_lines
from sl_nerfstudio.matching.ranges import TILE, TriedRanges
from sl_nerfstudio.parallel import compiled

LEAST_PATTERN_VARIANCE = 1e-3  # added to that of the drawn pattern: where it is flat, nothing can be compared
LEAST_IMAGE_VARIANCE = 0.03  # added to that of the image, as a share of its median at decoded pixels

HALF = 127  # the cost where image and pattern have nothing to do with each other
OUTSIDE = 255  # the cost beside the pattern
_WIDEST = 6  # tiles of a block

Statistics = tuple[Layer, Layer]
"""Mean of the image in the window of each pixel, and its variance, with what is added to it."""


def image_statistics(image: Layer, decoded: Mask, sigma: float) -> Statistics:
    """Mean and variance in windows of `sigma` pixels."""
    mean = _window(image, sigma)
    variance = np.maximum(_window(image * image, sigma) - mean * mean, 0)
    usual = float(np.median(variance[decoded])) if decoded.any() else float(np.median(variance))
    return mean, variance + np.float32(LEAST_IMAGE_VARIANCE * usual + 1e-9)


def matching_costs(
    image: Layer,
    statistics: Statistics,
    lines: EpipolarLines,
    inverse_distances: Float64[ndarray, "k"],
    tried: TriedRanges,
    grid: DrawnGrid,
    sigma: float,
) -> UInt8[ndarray, "cells"]:
    """Costs of what is tried: from 0 (correlation 1) over 127 (correlation 0) to 254 (-1); 255 beside the pattern."""
    mean, variance = statistics
    h, w = grid.layers.shape[:2]
    out = np.full(tried.cells, OUTSIDE, dtype=np.uint8)
    _fill_costs(
        lines.for_tiles, inverse_distances, _neighbours(grid.layers[..., 0]), (w, h),
        (image, mean, 1 / np.sqrt(variance)), _half_window(sigma), np.float32(LEAST_PATTERN_VARIANCE),
        tried.first, tried.count, tried.start, out,
    )  # fmt: skip
    return out


def _neighbours(picture: Layer) -> UInt32[ndarray, "h*w"]:
    """Each pixel of a picture between 0 and 1, and those to the right and below, as bytes: one access gets all four."""
    values = np.rint(255 * picture).astype(np.uint32)
    out = values.copy()
    out[:, :-1] |= values[:, 1:] << np.uint32(8)
    out[:-1] |= out[1:] << np.uint32(16)
    return out.ravel()


def correlations(image: Layer, statistics: Statistics, coords: Coords, grid: DrawnGrid, sigma: float) -> Layer:
    """Correlation of image and pattern at given coordinates."""
    mean, variance = statistics
    drawn = grid.at(coords)[..., 0]
    p, pp, ip = cv2.split(_window(np.dstack([drawn, drawn * drawn, drawn * image]), sigma))
    spread = np.maximum(pp - p * p, 0) + np.float32(LEAST_PATTERN_VARIANCE)
    return (ip - p * mean) / np.sqrt(spread * variance)


def _window(values: Float32[ndarray, "h w *k"], sigma: float) -> Float32[ndarray, "h w *k"]:
    size = 2 * _reach(sigma) + 1
    return cv2.GaussianBlur(values, (size, size), sigma, borderType=cv2.BORDER_REFLECT)


def _half_window(sigma: float) -> Float32[ndarray, "r"]:
    """Weights from the middle of a Gaussian window to its end."""
    reach = _reach(sigma)
    return cv2.getGaussianKernel(2 * reach + 1, sigma, cv2.CV_32F)[reach:, 0].copy()


def _reach(sigma: float) -> int:
    """Pixels from the middle of a Gaussian window to its end, at three standard deviations."""
    return int(np.ceil(3 * sigma))


@compiled
def _fill_costs(
    lines: tuple[int, ndarray, ndarray, ndarray],
    inverse_distances: ndarray,
    words: ndarray,
    size: tuple[int, int],
    values: tuple[ndarray, ndarray, ndarray],
    weights: ndarray,
    least: float,
    first: ndarray,
    count: ndarray,
    start: ndarray,
    out: ndarray,
) -> None:
    """Fill the costs, block by block. `values`: image, mean and inverse deviation in the window of each pixel."""
    code, parameters, centre, planes = lines
    image, mean, scale = values
    h, w = image.shape
    reach = len(weights) - 1
    most = (TILE + 2 * reach) * (_WIDEST * TILE + 2 * reach)
    ray, grey, room = np.empty((5, most), np.float32), np.empty((3, most), np.float32), np.empty((8, most), np.float32)
    read, inside, costs = np.empty(most, np.uint32), np.empty(most, np.bool_), np.empty(most, np.uint8)
    for a in range(first.shape[0]):
        b = 0
        while b < first.shape[1]:
            end, low, high = _block(first[a], count[a], b, 2 * reach)
            rows, width = min(TILE, h - a * TILE), min(end * TILE, w) - b * TILE + 2 * reach
            whole, middle, inner = (rows + 2 * reach) * width, rows * width, rows * width - 2 * reach
            corner, begin = (a * TILE - reach, b * TILE - reach), reach * width + reach
            if high > low:
                for n in range(5):
                    _cut_out(planes[n], corner, width, ray[n, :whole])
                _cut_out(image, corner, width, grey[0, :whole])
                _cut_out(mean, corner, width, grey[1, :whole])
                _cut_out(scale, corner, width, grey[2, :whole])
            x, y = room[0, :whole], room[1, :whole]
            drawn, square, product = room[2, :whole], room[3, :whole], room[4, :whole]
            for k in range(low, high):
                places_on_lines(code, parameters, ray, centre, inverse_distances[k], x, y)
                _draw(words, size, x, y, read, inside, drawn)
                _multiply(drawn, grey[0], square, product)
                for n in range(3):
                    _blur(room[2 + n], weights, width, room[5 + n, :middle])
                    _blur(room[5 + n], weights, 1, room[n, :inner])
                _write(
                    room[0], room[1], room[2], grey[1, begin:], grey[2, begin:], inside[begin:], least, costs[:inner]
                )
                for tile in range(b, end):
                    n, place = count[a, tile], k - first[a, tile]
                    if 0 <= place < n:
                        columns = min(TILE, w - tile * TILE)
                        _spread(costs[(tile - b) * TILE :], width, rows, columns, n, out[start[a, tile] + place :])
            b = end


@compiled
def _block(first: ndarray, count: ndarray, begin: int, border: int) -> tuple[int, int, int]:
    """The end of a block of tiles of a row, and of the range of all: as many as are together less than apart."""
    end, low, high = begin + 1, first[begin], first[begin] + count[begin]
    while end < min(begin + _WIDEST, len(first)) and count[begin] > 0 and count[end] > 0:
        lower, higher = min(low, first[end]), max(high, first[end] + count[end])
        wide = TILE * (end - begin) + border
        if (higher - lower) * (wide + TILE) > (high - low) * wide + count[end] * (TILE + border):
            break
        end, low, high = end + 1, lower, higher
    return end, low, high


@compiled
def _cut_out(values: ndarray, corner: tuple[int, int], width: int, out: ndarray) -> None:
    """Rows of a part of the image, one after the other; beyond the image's border, it is reflected."""
    h, w = values.shape
    for row in range(len(out) // width):
        i = _reflected(corner[0] + row, h)
        for column in range(width):
            out[row * width + column] = values[i, _reflected(corner[1] + column, w)]


@compiled
def _reflected(place: int, size: int) -> int:
    place = -1 - place if place < 0 else 2 * size - 1 - place if place >= size else place
    return min(max(place, 0), size - 1)


@compiled
def _draw(
    words: ndarray, size: tuple[int, int], x: ndarray, y: ndarray, read: ndarray, inside: ndarray, out: ndarray
) -> None:
    """The picture at columns x and rows y, bilinear, and which of them are inside; beside it as at its border.

    One loop gets the words, because the others can then work on several numbers at once.
    """
    width, zero, half = np.int32(size[0]), np.float32(0), np.float32(0.5)
    right, lower = np.float32(size[0] - 1), np.float32(size[1] - 1)
    last, lowest = np.int32(size[0] - 2), np.int32(size[1] - 2)
    for n in range(len(out)):
        u, v = min(max(zero, x[n]), right), min(max(zero, y[n]), lower)
        i, j = min(np.int32(u), last), min(np.int32(v), lowest)
        inside[n] = (x[n] >= -half) & (y[n] >= -half) & (x[n] <= right + half) & (y[n] <= lower + half)
        read[n] = np.uint32(j * width + i)
        x[n], y[n] = u - np.float32(i), v - np.float32(j)
    for n in range(len(out)):
        read[n] = words[read[n]]
    byte, scale = np.int32(255), np.float32(1 / 255)
    for n in range(len(out)):
        word = np.int32(read[n])
        a, b = np.float32(word & byte), np.float32((word >> 8) & byte)
        c, d = np.float32((word >> 16) & byte), np.float32((word >> 24) & byte)
        above, below = a + x[n] * (b - a), c + x[n] * (d - c)
        out[n] = (above + y[n] * (below - above)) * scale


@compiled
def _multiply(drawn: ndarray, image: ndarray, square: ndarray, product: ndarray) -> None:
    for n in range(len(drawn)):
        square[n], product[n] = drawn[n] * drawn[n], drawn[n] * image[n]


@compiled
def _blur(values: ndarray, weights: ndarray, step: int, out: ndarray) -> None:
    """Weighted sums of values and those some steps before and after; first of the first value that has them all."""
    reach = len(weights) - 1
    middle = values[reach * step :]
    for n in range(len(out)):
        out[n] = weights[0] * middle[n]
    for k in range(1, reach + 1):
        weight, before, after = weights[k], values[(reach - k) * step :], values[(reach + k) * step :]
        for n in range(len(out)):
            out[n] += weight * (before[n] + after[n])


@compiled
def _write(
    p: ndarray, pp: ndarray, ip: ndarray, mean: ndarray, scale: ndarray, inside: ndarray, least: float, out: ndarray
) -> None:
    half, one = np.float32(HALF), np.float32(1)
    for n in range(len(out)):
        m = p[n]
        spread = max(pp[n] - m * m, np.float32(0)) + least
        correlation = (ip[n] - m * mean[n]) * scale[n] / np.sqrt(spread)
        cost = np.uint8(min(max(half * (one - correlation), np.float32(0)), 2 * half))
        out[n] = cost if inside[n] else np.uint8(OUTSIDE)


@compiled
def _spread(costs: ndarray, width: int, rows: int, columns: int, count: int, out: ndarray) -> None:
    """The costs of one inverse distance, `count` places from pixel to pixel."""
    for row in range(rows):
        for column in range(columns):
            out[(row * TILE + column) * count] = costs[row * width + column]
