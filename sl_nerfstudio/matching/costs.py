"""How badly image and pattern match at every pixel for every inverse distance that is tried."""

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8
from numpy import ndarray

from sl_nerfstudio.decoding.grid.drawn_grid import DrawnGrid
from sl_nerfstudio.matching.cost_loops import fill_costs, interleave, mark_outside, sample
from sl_nerfstudio.matching.epipolar_lines import EpipolarLines
from sl_nerfstudio.matching.settings import CostSettings

_TOGETHER = 16  # inverse distances whose costs are written at once
_BAND = 48  # rows whose costs are computed at once: all that is needed on the way stays in the processor's memory

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
    picture, weights = np.ascontiguousarray(grid.layers[..., 0]), _half_window(sigma)
    least, h = np.float32(settings.least_pattern_variance), len(image)
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
    settings: CostSettings,
) -> Float32[ndarray, "h w"]:
    """Correlation of image and pattern at given coordinates."""
    mean, variance = statistics
    drawn = grid.at(coords)[..., 0]
    p, pp, ip = cv2.split(_window(np.dstack([drawn, drawn * drawn, drawn * image]), sigma))
    spread = np.maximum(pp - p * p, 0) + np.float32(settings.least_pattern_variance)
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
