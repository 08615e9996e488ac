"""Matching costs of image and pattern at every pixel for every inverse distance, and the distances that cost least.

Costs are correlations in Gaussian windows. Semi-global matching (Hirschmueller, "Stereo processing by semiglobal
matching and mutual information", PAMI 2008) adds them up along eight ways to each pixel; changes of distance cost a
little to the next one and more to any other. Changes are counted from the slope of the surface that was decoded, where
one was: otherwise steep surfaces would cost more than those that face the camera (Scharstein, Taniai and Sinha,
"Semi-global stereo matching with surface orientation priors", 3DV 2017).
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, UInt8
from numpy import ndarray

from sl_nerfstudio.decoding.grid_fit import DrawnGrid
from sl_nerfstudio.matching.lines import EpipolarLines
from sl_nerfstudio.parallel import compiled

LEAST_PATTERN_VARIANCE = 1e-3  # added to that of the drawn pattern: where it is flat, nothing can be compared
LEAST_IMAGE_VARIANCE = 0.03  # added to that of the image, as a share of its median at decoded pixels
SMALL, LARGE = 30, 250  # costs of a change to the next inverse distance, and to any other
STEEPEST = 4  # steps from one pixel to the next up to which a decoded surface is steep; beyond, it has a jump there
APART = 3  # steps from the best inverse distance within which another one is no rival

HALF = 127  # the cost where image and pattern have nothing to do with each other
OUTSIDE = 255  # the cost beside the pattern
_TOGETHER = 16  # inverse distances whose costs are written at once
_BAND = 48  # rows whose costs are computed at once: all that is needed on the way stays in the processor's memory
_NEVER = np.int16(16000)  # more than any way costs

Statistics = tuple[Float32[ndarray, "h w"], Float32[ndarray, "h w"]]
"""Mean of the image in the window of each pixel, and its variance, with what is added to it."""


def image_statistics(image: Float32[ndarray, "h w"], decoded: Bool[ndarray, "h w"], sigma: float) -> Statistics:
    """Mean and variance in windows of `sigma` pixels."""
    mean = _window(image, sigma)
    variance = np.maximum(_window(image * image, sigma) - mean * mean, 0)
    usual = float(np.median(variance[decoded])) if decoded.any() else float(np.median(variance))
    return mean, variance + np.float32(LEAST_IMAGE_VARIANCE * usual + 1e-9)


def matching_costs(
    image: Float32[ndarray, "h w"],
    statistics: Statistics,
    lines: EpipolarLines,
    inverse_distances: Float64[ndarray, "k"],
    grid: DrawnGrid,
    sigma: float,
) -> UInt8[ndarray, "h w k"]:
    """Costs from 0 (correlation 1) over 127 (correlation 0) to 254 (correlation -1); 255 beside the pattern."""
    mean, variance = statistics
    scale = 1 / np.sqrt(variance)
    picture, weights = np.ascontiguousarray(grid.layers[..., 0]), _half_window(sigma)
    least, h = np.float32(LEAST_PATTERN_VARIANCE), len(image)
    out = np.empty((*image.shape, len(inverse_distances)), dtype=np.uint8)
    for first in range(0, h, _BAND):
        inner, around = _with_window(first, h, len(weights) - 1)
        band, there = lines.part((around, slice(None))), (image[around], mean[around], scale[around])
        x, y, drawn = (np.empty(image[around].shape, dtype=np.float32) for _ in range(3))
        block = np.empty((_TOGETHER, *x.shape), dtype=np.uint8)
        for start in range(0, len(inverse_distances), _TOGETHER):
            some = inverse_distances[start : start + _TOGETHER]
            for w, costs in zip(some, block, strict=False):
                band.pixels_at(w, x, y)
                sample(picture, x, y, drawn)
                fill_costs(drawn, *there, weights, least, costs)
                mark_outside(x, y, picture.shape, costs)
            interleave(block[: len(some), inner], start, out[first : first + _BAND])
    return out


def _with_window(first: int, h: int, reach: int) -> tuple[slice, slice]:
    """Rows of a band within those that its windows need, and the latter."""
    begin, end = max(first - reach, 0), min(first + _BAND + reach, h)
    return slice(first - begin, min(first + _BAND, h) - begin), slice(begin, end)


def correlations(
    image: Float32[ndarray, "h w"],
    statistics: Statistics,
    coords: Float32[ndarray, "h w 2"],
    grid: DrawnGrid,
    sigma: float,
) -> Float32[ndarray, "h w"]:
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
    half, one = np.float32(HALF), np.float32(1)
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


# Semi-global matching.


@dataclass(frozen=True)
class StereoMatches:
    """The best of the inverse distances that were tried, for every pixel."""

    index: Float32[ndarray, "h w"]  # its number, with the fraction of a step that a parabola through the sums says
    cost: UInt8[ndarray, "h w"]  # its own, without changes
    margin: Float32[ndarray, "h w"]  # by how much the sums of the best rival are larger

    def part(self, rows: slice) -> "StereoMatches":
        """The matches of some rows."""
        return StereoMatches(self.index[rows], self.cost[rows], self.margin[rows])

    @staticmethod
    def joined(parts: Sequence["StereoMatches"]) -> "StereoMatches":
        """The matches of parts, one below the other."""
        return StereoMatches(
            *(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(StereoMatches))
        )


def match_semi_globally(costs: UInt8[ndarray, "h w k"], decoded: Int32[ndarray, "h w"]) -> StereoMatches:
    """The best match of every pixel. There must be at least three inverse distances.

    `decoded` are the numbers of those that were decoded, `UNKNOWN` where nothing was.
    """
    sums = np.zeros(costs.shape, dtype=np.uint16)
    for step in (1, -1):
        _add_ways(costs, decoded, step, SMALL, LARGE, STEEPEST, sums)
    h, w = costs.shape[:2]
    index, cost = np.empty((h, w), dtype=np.float32), np.empty((h, w), dtype=np.uint8)
    margin = np.empty((h, w), dtype=np.float32)
    _choose(costs, sums, APART, index, cost, margin)
    return StereoMatches(index, cost, margin)


@compiled
def _add_ways(
    costs: ndarray, decoded: ndarray, step: int, small: int, large: int, steepest: int, sums: ndarray
) -> None:
    """Add to `sums` what the least costly way to each pixel costs, less what all its ways share, for four directions.

    With a step of 1, they come from the left and from the three pixels above; with -1 from the opposite ones.
    """
    h, w, count = costs.shape
    beyond = steepest + 1  # places on both sides of a way for inverse distances that are not tried
    shape = (3, w, count + 2 * beyond)
    before, here = np.full(shape, _NEVER, dtype=np.int16), np.full(shape, _NEVER, dtype=np.int16)
    least_before, least_here = np.zeros((3, w), dtype=np.int16), np.zeros((3, w), dtype=np.int16)
    side, least_side = np.full((2, shape[2]), _NEVER, dtype=np.int16), np.int16(0)
    away, near = np.int16(large), np.int16(small)
    for i in range(h):
        row = i if step > 0 else h - 1 - i
        for j in range(w):
            column = j if step > 0 else w - 1 - j
            own, out = costs[row, column], side[j % 2]
            if j == 0:
                least_side = _begin(own, beyond, out)
            else:
                slope = _slope(decoded, row, column, row, column - step, steepest)
                least_side = _go_on(own, side[(j + 1) % 2], least_side, beyond - slope, beyond, near, away, out)
            for n in range(3):
                last, out = column + n - 1, here[n, column]
                if i == 0 or last < 0 or last >= w:
                    least_here[n, column] = _begin(own, beyond, out)
                else:
                    slope = _slope(decoded, row, column, row - step, last, steepest)
                    came, least = before[n, last], least_before[n, last]
                    least_here[n, column] = _go_on(own, came, least, beyond - slope, beyond, near, away, out)
            _add(side[j % 2], here[:, column], beyond, sums[row, column])
        before, here, least_before, least_here = here, before, least_here, least_before


@compiled
def _slope(decoded: ndarray, row: int, column: int, row_before: int, column_before: int, steepest: int) -> int:
    """Steps of the inverse distance from the pixel before to this one; 0 where there is a jump or nothing decoded."""
    steps = decoded[row, column] - decoded[row_before, column_before]
    return steps if abs(steps) <= steepest else 0


@compiled
def _begin(costs: ndarray, beyond: int, out: ndarray) -> np.int16:
    """The first pixel of a way; returns the least of `out`."""
    least = _NEVER
    for k in range(len(costs)):
        out[beyond + k] = costs[k]
        least = min(least, np.int16(costs[k]))
    return least


@compiled
def _go_on(
    costs: ndarray,
    came: ndarray,
    least: np.int16,
    first: int,
    beyond: int,
    near: np.int16,
    away: np.int16,
    out: ndarray,
) -> np.int16:
    """Go from one pixel to the next, in 16 bits throughout; returns the least of `out`.

    The first inverse distance continues place `first` of the pixel before, the others the places after it.
    """
    count = len(costs)
    below, same, above = came[first - 1 :], came[first:], came[first + 1 :]
    ways, jump, smallest = out[beyond : beyond + count], np.int16(least + away), _NEVER
    for k in range(count):
        cheapest = min(min(np.int16(min(below[k], above[k]) + near), same[k]), jump)
        way = np.int16(np.int16(cheapest - least) + np.int16(costs[k]))
        ways[k] = way
        smallest = min(smallest, way)
    return smallest


@compiled
def _add(side: ndarray, others: ndarray, beyond: int, sums: ndarray) -> None:
    count = len(sums)
    a, b, c, d = side[beyond:], others[0, beyond:], others[1, beyond:], others[2, beyond:]
    for k in range(count):
        sums[k] += np.uint16(a[k] + b[k] + c[k] + d[k])


@compiled
def _choose(costs: ndarray, sums: ndarray, apart: int, index: ndarray, cost: ndarray, margin: ndarray) -> None:
    h, w, count = sums.shape
    for row in range(h):
        for column in range(w):
            total = sums[row, column]
            best = 0
            for k in range(1, count):
                if total[k] < total[best]:
                    best = k
            rival = 65535
            for k in range(count):
                if abs(k - best) > apart and total[k] < rival:
                    rival = total[k]
            cost[row, column], margin[row, column] = costs[row, column, best], rival - np.int64(total[best])
            middle = min(max(best, 1), count - 2)
            a, b, c = np.int64(total[middle - 1]), np.int64(total[middle]), np.int64(total[middle + 1])
            bend = a - 2 * b + c
            index[row, column] = middle + (min(max((a - c) / (2 * bend), -1), 1) if bend > 0 else best - middle)
