"""One least-squares step of the dense fit: light, and shift of the coordinates, in a window about each place.

Lucas and Kanade (1981), with brightness and contrast as further unknowns. All sums that the normal equations need are
moments of the image, the drawn pattern and its derivatives.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from sl_nerfstudio.compiled import compiled
from sl_nerfstudio.decoding.grid.drawn_grid import DrawnGrid, Light
from sl_nerfstudio.decoding.grid.smoothing import enlarge, gaussian_means

# Windows.
_SQUARES = 8  # per period, for which fits are made
_LIGHT_WINDOW = 0.38  # in which the light is taken to be even, periods
# Light.
_LEAST_CONTRAST, _WELL_LIT = 0.25, 0.9  # share of the contrast at this quantile of the image
# Shift.
_LARGEST_STEP = 0.2  # periods
_PRIOR = 0.1  # weight of a shift of one period, as a share of the window's contrast
_LEAST_RELATIVE_CONTRAST = 0.05  # of the contrast that the image has in the window
_LEAST_AGREEMENT, _LEAST_SEEN = 0.05, 0.05  # with which the variance of a shift is stated


class ShiftFit(NamedTuple):
    """What moves the drawn pattern onto the image at each pixel."""

    shift: Float32[ndarray, "h w 2"]  # of the coordinates, periods
    agreement: Float32[ndarray, "h w"]  # correlation of image and pattern
    variance: Float32[ndarray, "h w"]  # of the shift along either axis if pixels err independently, periods squared


def fit_shift(
    image: Float32[ndarray, "h w"],
    coords: Float32[ndarray, "h w 2"],
    trust: Float32[ndarray, "h w"],
    grid: DrawnGrid,
    light: Light,
    pixels_a_period: float,
    window: float,
) -> ShiftFit:
    """The fit in a Gaussian window about each pixel, whose standard deviation is `window` periods."""
    step = _square_size(pixels_a_period)
    m = _moments(image, light.on(grid.at(coords)), trust, step)
    found = np.empty((*m.shape[1:3], 4), dtype=np.float32)
    sigma = window * pixels_a_period
    _solve(gaussian_means(m, sigma / step), np.float32(4 * np.pi * sigma**2), found)
    fit = enlarge(found, image.shape, step)
    return ShiftFit(fit[..., :2], fit[..., 2], fit[..., 3])


def measure_light(
    image: Float32[ndarray, "h w"],
    coords: Float32[ndarray, "h w 2"],
    trust: Float32[ndarray, "h w"],
    grid: DrawnGrid,
    pixels_a_period: float,
) -> Light:
    """The light in the image, from coordinates that are nearly right."""
    step = _square_size(pixels_a_period)
    m = _moments(image, grid.at(coords), trust, step)
    means = gaussian_means(m[:2], _LIGHT_WINDOW * pixels_a_period / step)
    contrast, brightness = _contrast_and_brightness(means)
    light = enlarge(np.dstack([contrast, brightness]), image.shape, step)
    return Light(light[..., 0], light[..., 1])


def _square_size(pixels_a_period: float) -> int:
    """Side of the squares of pixels for which fits are made."""
    return max(1, round(pixels_a_period / _SQUARES))


def _moments(
    image: Float32[ndarray, "h w"], drawn: Float32[ndarray, "h w 3"], trust: Float32[ndarray, "h w"], step: int
) -> Float32[ndarray, "4 a b 4"]:
    """Products of the pattern p, its derivatives px and py and the image i, averaged over squares of `step` pixels.

    In groups of four: (1, p, pp, i), (ip, ii, px, py), (p px, p py, px px, px py), (py py, i px, i py, 0).
    """
    h, w = image.shape
    out = np.zeros((4, -(-h // step), -(-w // step), 4), dtype=np.float32)
    _add_products(image, drawn, trust, step, out)
    return out


@compiled
def _add_products(image: ndarray, drawn: ndarray, trust: ndarray, step: int, out: ndarray) -> None:
    h, w = image.shape
    share = np.float32(1 / step**2)
    for row in range(h):
        for column in range(w):
            weight, i = trust[row, column] * share, image[row, column]
            p, px, py = drawn[row, column, 0], drawn[row, column, 1], drawn[row, column, 2]
            r, c = row // step, column // step
            products = (
                (np.float32(1), p, p * p, i),
                (i * p, i * i, px, py),
                (p * px, p * py, px * px, px * py),
                (py * py, i * px, i * py, np.float32(0)),
            )
            for group in range(4):
                for k in range(4):
                    out[group, r, c, k] += weight * products[group][k]


def _contrast_and_brightness(
    m: Float32[ndarray, "2 h w 4"],
) -> tuple[Float32[ndarray, "h w"], Float32[ndarray, "h w"]]:
    """By least squares; the contrast is at least a quarter of that in the well lit parts of the image."""
    n = np.maximum(m[0, ..., 0], 1e-6)
    mp, pp, mi, ip = m[0, ..., 1] / n, m[0, ..., 2] / n, m[0, ..., 3] / n, m[1, ..., 0] / n
    variance = np.maximum(pp - mp * mp, 1e-6)
    contrast = (ip - mi * mp) / variance
    seen = contrast[m[0, ..., 0] > 0.5]
    floor = _LEAST_CONTRAST * float(np.quantile(seen, _WELL_LIT)) if len(seen) else 0.0
    contrast = np.maximum(contrast, max(floor, 1e-3))
    return contrast, mi - contrast * mp


@compiled
def _solve(means: ndarray, pixels: float, out: ndarray) -> None:
    """Shift (x, y) by least squares, brightness and contrast eliminated, correlation of image and pattern, variance.

    `pixels` are those that count in a whole window.
    """
    h, w = out.shape[:2]
    for row in range(h):
        for column in range(w):
            a, b, c, d = means[0, row, column], means[1, row, column], means[2, row, column], means[3, row, column]
            n = max(a[0], np.float32(1e-6))
            mp, mi, mx, my = a[1] / n, a[3] / n, b[2] / n, b[3] / n
            pp, xp, yp = max(a[2] / n - mp * mp, np.float32(1e-6)), c[0] / n - mp * mx, c[1] / n - mp * my
            xx, xy, yy = c[2] / n - mx * mx, c[3] / n - mx * my, d[0] / n - my * my
            ip, ix, iy = b[0] / n - mi * mp, d[1] / n - mi * mx, d[2] / n - mi * my
            ii = b[1] / n - mi * mi
            agreement = ip / np.sqrt(pp * max(ii, 1e-10))
            # i = b + a p + a (sx px + sy py): eliminate p, then solve 2 x 2 equations for a sx and a sy.
            xx, xy, yy = xx - xp * xp / pp, xy - xp * yp / pp, yy - yp * yp / pp
            ix, iy = ix - xp * ip / pp, iy - yp * ip / pp
            ridge = _PRIOR * (xx + yy) + 1e-6
            xx, yy = xx + ridge, yy + ridge
            determinant = max(xx * yy - xy * xy, 1e-9)
            contrast = max(ip / pp, _LEAST_RELATIVE_CONTRAST * np.sqrt(max(ii, 0) / pp) + 1e-6)
            trusted = min(max(agreement, 0), 1)  # where the two disagree, their difference is meaningless
            for axis in range(2):
                shift = (yy * ix - xy * iy if axis == 0 else xx * iy - xy * ix) / (determinant * contrast)
                out[row, column, axis] = min(max(shift, -_LARGEST_STEP), _LARGEST_STEP) * trusted
            out[row, column, 2] = agreement
            sure = min(max(agreement, np.float32(_LEAST_AGREEMENT)), np.float32(1))
            seen = pixels * max(n, np.float32(_LEAST_SEEN))
            out[row, column, 3] = (1 / (sure * sure) - 1) * pp * (xx + yy) / (2 * determinant * seen)
