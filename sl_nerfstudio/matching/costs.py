"""How badly image and pattern match at every pixel for every inverse distance that is tried."""

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8
from numpy import ndarray

from sl_nerfstudio.compiled import compiled
from sl_nerfstudio.decoding.grid.drawn_grid import DrawnGrid
from sl_nerfstudio.matching.epipolar_lines import EpipolarLines
from sl_nerfstudio.matching.settings import CostSettings

_HALF = 127  # the cost where image and pattern have nothing to do with each other
OUTSIDE = 255  # the cost beside the pattern
_TOGETHER = 16  # inverse distances whose costs are written at once

Statistics = tuple[Float32[ndarray, "h w"], Float32[ndarray, "h w"]]
"""Mean of the image in the window of each pixel, and its variance, with what is added to it."""


def image_statistics(
    image: Float32[ndarray, "h w"], decoded: Bool[ndarray, "h w"], sigma: float, settings: CostSettings
) -> Statistics:
    """For windows of `sigma` pixels."""
    mean = _window(image, sigma)
    variance = np.maximum(_window(image * image, sigma) - mean * mean, 0)
    usual = float(np.median(variance[decoded])) if decoded.any() else float(np.median(variance))
    return mean, variance + np.float32(settings.least_image_variance * usual + 1e-9)


def matching_costs(
    image: Float32[ndarray, "h w"],
    statistics: Statistics,
    lines: EpipolarLines,
    inverse_distances: Float64[ndarray, "k"],
    grid: DrawnGrid,
    sigma: float,
    settings: CostSettings,
) -> UInt8[ndarray, "h w k"]:
    """From 0 (correlation 1) over 127 (correlation 0) to 254 (correlation -1); 255 beside the pattern."""
    mean, variance = statistics
    scale = 1 / np.sqrt(variance)
    picture = np.ascontiguousarray(grid.layers[..., 0])
    out = np.empty((*image.shape, len(inverse_distances)), dtype=np.uint8)
    x, y = np.empty(image.shape, dtype=np.float32), np.empty(image.shape, dtype=np.float32)
    block = np.empty((_TOGETHER, *image.shape), dtype=np.uint8)
    for first in range(0, len(inverse_distances), _TOGETHER):
        some = inverse_distances[first : first + _TOGETHER]
        for w, costs in zip(some, block, strict=False):
            lines.pixels_at(w, x, y)
            drawn = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            parts = (_window(part, sigma) for part in (drawn, cv2.multiply(drawn, drawn), cv2.multiply(drawn, image)))
            _fill_costs(*parts, mean, scale, x, y, picture.shape, settings.least_pattern_variance, costs)
        _interleave(block[: len(some)], first, out)
    return out


def correlations(
    image: Float32[ndarray, "h w"],
    statistics: Statistics,
    coords: Float32[ndarray, "h w 2"],
    grid: DrawnGrid,
    sigma: float,
    settings: CostSettings,
) -> Float32[ndarray, "h w"]:
    """Correlation of image and pattern at given coordinates."""
    mean, variance = statistics
    drawn = grid.at(coords)[..., 0]
    p, pp, ip = cv2.split(_window(np.dstack([drawn, drawn * drawn, drawn * image]), sigma))
    spread = np.maximum(pp - p * p, 0) + np.float32(settings.least_pattern_variance)
    return (ip - p * mean) / np.sqrt(spread * variance)


def _window(values: Float32[ndarray, "h w *k"], sigma: float) -> Float32[ndarray, "h w *k"]:
    return cv2.GaussianBlur(values, (0, 0), sigma, borderType=cv2.BORDER_REFLECT)


@compiled
def _fill_costs(
    p: ndarray, pp: ndarray, ip: ndarray, mean: ndarray, scale: ndarray, x: ndarray, y: ndarray,
    size: tuple[int, int], least: float, out: ndarray,
) -> None:  # fmt: skip
    half, bottom = np.float32(0.5), np.float32(least)
    right, lower = np.float32(size[1] - 0.5), np.float32(size[0] - 0.5)
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            m = p[row, column]
            spread = max(pp[row, column] - m * m, np.float32(0)) + bottom
            correlation = (ip[row, column] - m * mean[row, column]) * scale[row, column] / np.sqrt(spread)
            cost = min(max(np.float32(_HALF) * (1 - correlation), np.float32(0)), np.float32(2 * _HALF))
            u, v = x[row, column], y[row, column]
            inside = u >= -half and v >= -half and u <= right and v <= lower  # False for NaN
            out[row, column] = np.uint8(cost) if inside else OUTSIDE


@compiled
def _interleave(block: ndarray, first: int, out: ndarray) -> None:
    """Several images of costs into the volume: one at a time, each pixel would be a place of its own in memory."""
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            for k in range(len(block)):
                out[row, column, first + k] = block[k, row, column]
