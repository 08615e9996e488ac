"""Coordinates refined on the image itself.

Once it is known which part of the pattern a region shows, the pattern can be drawn there and compared with the capture.
In a Gaussian window about each place, brightness, contrast and a shift of the coordinates are fitted by least squares:
the phases of the network only have to be roughly right.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

from sl_nerfstudio.decoding.grid.drawn_grid import DrawnGrid, Light
from sl_nerfstudio.decoding.grid.shift_fit import fit_shift, measure_light
from sl_nerfstudio.decoding.grid.smoothing import flattened, shrink
from sl_nerfstudio.decoding.regions import large_regions

# Regions.
_TEAR = 0.35  # periods between neighbouring pixels
_LEAST_AREA = 1.0  # smaller regions are left out, periods squared
# Resolution.
_FINEST = 12.0  # pixels per period: finer captures are averaged first
_LEAST_INSIDE = 0.3  # share of the averaged pixels that must be in the region
# Iteration.
_WINDOW = 0.42  # of a shift, periods
_ROUNDS = 6  # each recovers a part of the detail that the window of the fit averages over
_SMOOTHING = ((0.35, 0.05), (0.12, 0.1))  # windows in which coordinates are taken to be linear, and how far from them
# the pixel's own may be for that; periods
_LARGEST_SHIFT = 0.12  # periods, of all rounds together


def fit_densely(
    image: Float32[ndarray, "h w"],
    coords: Float32[ndarray, "h w 2"],
    trust: Float32[ndarray, "h w"],
    grids: tuple[DrawnGrid, ...],
    pixels_a_period: float,
) -> tuple[Float32[ndarray, "h w 2"], Float32[ndarray, "h w"]]:
    """Refined coordinates in pattern pixels, and the correlation of pattern and image there (-1 to 1).

    `trust` is the weight of each pixel, from 0 to 1: in a shadow the image must not pull at the pattern.
    `coords` may be off by a quarter of a period; regions smaller than a period squared are left out.
    """
    out = np.full_like(coords, np.nan)
    agreement = np.zeros(image.shape, dtype=np.float32)
    factor = max(1, int(pixels_a_period / _FINEST))
    least = _LEAST_AREA * pixels_a_period**2
    for box, inside in large_regions(coords, _TEAR * grids[0].period, least):
        coarse = _coarser(image[box], coords[box], trust[box] * inside, inside, factor)
        values, fit = _refine(*coarse, grids, pixels_a_period / factor)
        values, fit = _finer(values, inside.shape, factor), _finer(fit, inside.shape, factor)
        out[box][inside], agreement[box][inside] = values[inside], fit[inside]
    return out, agreement


def _coarser(
    image: Float32[ndarray, "h w"],
    coords: Float32[ndarray, "h w 2"],
    trust: Float32[ndarray, "h w"],
    inside: Bool[ndarray, "h w"],
    factor: int,
) -> tuple[Float32[ndarray, "a b"], Float32[ndarray, "a b 2"], Float32[ndarray, "a b"], Bool[ndarray, "a b"]]:
    """Means over squares of `factor` pixels: faster for fine captures, and as accurate."""
    if factor == 1:
        return image, coords, trust, inside
    h, w = inside.shape
    size = (-(-w // factor), -(-h // factor))
    weight = inside.astype(np.float32)
    values = np.where(inside[..., None], coords, 0)
    mean = shrink(np.dstack([weight, image * weight, values, trust]).astype(np.float32), size, factor)
    known = np.maximum(mean[..., :1], 1e-6)
    mean[..., 1:] /= known
    covered = mean[..., 0] > _LEAST_INSIDE
    return mean[..., 1].copy(), mean[..., 2:4].copy(), mean[..., 4] * covered, covered


def _finer(values: Float32[ndarray, "a b *c"], shape: tuple[int, ...], factor: int) -> Float32[ndarray, "h w *c"]:
    """Bilinear values at the pixels that `_coarser` averaged."""
    if factor == 1:
        return values
    size = values.shape[1] * factor, values.shape[0] * factor
    return cv2.resize(values, size, interpolation=cv2.INTER_LINEAR)[: shape[0], : shape[1]]


def _refine(
    image: Float32[ndarray, "h w"],
    coords: Float32[ndarray, "h w 2"],
    trust: Float32[ndarray, "h w"],
    inside: Bool[ndarray, "h w"],
    grids: tuple[DrawnGrid, ...],
    pixels_a_period: float,
) -> tuple[Float32[ndarray, "h w 2"], Float32[ndarray, "h w"]]:
    """A few rounds of fitting shifts, with the sharpness that agrees best with the image.

    Outside `inside`, values continue the nearest planes.
    """
    if not inside.any():
        return np.full_like(coords, np.nan), np.zeros_like(image)
    period = grids[0].period
    coords = _smooth(coords, inside, pixels_a_period, period)
    start, even = coords, Light.even(image.shape)
    fits = [fit_shift(image, coords, trust, grid, even, pixels_a_period, _WINDOW) for grid in grids]
    best = int(np.argmax([fit.agreement[inside].mean() for fit in fits]))
    shift, light = fits[best].shift, measure_light(image, coords, trust, grids[best], pixels_a_period)
    for index in range(_ROUNDS):
        moved = coords + shift * np.float32(period) - start
        limit = np.float32(_LARGEST_SHIFT * period)
        coords = start + np.clip(moved, -limit, limit)
        if index == 0:  # the network's remaining noise; smoothing in every round would flatten the surface
            coords = _smooth(coords, inside, pixels_a_period, period)
        shift = fit_shift(image, coords, trust, grids[best], light, pixels_a_period, _WINDOW).shift
    # Judged in even light: what only the fitted light explains must not count as agreement.
    return coords, fit_shift(image, coords, trust, grids[best], even, pixels_a_period, _WINDOW).agreement


def _smooth(
    coords: Float32[ndarray, "h w 2"], inside: Bool[ndarray, "h w"], pixels_a_period: float, period: float
) -> Float32[ndarray, "h w 2"]:
    """On planes that are near the pixel's own coordinates."""

    def is_near(apart: Float32[ndarray, "h w 2"], limit: float) -> Bool[ndarray, "h w"]:
        return apart[..., 0] ** 2 + apart[..., 1] ** 2 < (limit * period) ** 2

    windows = [(window * pixels_a_period, limit) for window, limit in _SMOOTHING]
    return flattened(coords, inside, windows, is_near)
