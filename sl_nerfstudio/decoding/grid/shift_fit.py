"""One least-squares step of the dense fit: light, and shift of the coordinates, in a window about each place.

Lucas and Kanade (1981), with brightness and contrast as further unknowns. All sums that the normal equations need are
moments of the image, the drawn pattern and its derivatives.
"""

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from sl_nerfstudio.decoding.grid.drawn_grid import DrawnGrid, Light
from sl_nerfstudio.decoding.grid.smoothing import enlarge, gaussian_means, shrink

# Windows.
_SQUARES = 8  # per period, for which fits are made
_SHIFT_WINDOW = 0.42  # of a shift, periods
_LIGHT_WINDOW = 0.38  # in which the light is taken to be even, periods
# Light.
_LIGHT_MOMENTS = [0, 1, 4, 10, 11]  # those that contrast and brightness follow from
_LEAST_CONTRAST, _WELL_LIT = 0.25, 0.9  # share of the contrast at this quantile of the image
# Shift.
_LARGEST_STEP = 0.2  # periods
_PRIOR = 0.1  # weight of a shift of one period, as a share of the window's contrast
_LEAST_RELATIVE_CONTRAST = 0.05  # of the contrast that the image has in the window


def fit_shift(
    image: Float32[ndarray, "h w"],
    coords: Float32[ndarray, "h w 2"],
    trust: Float32[ndarray, "h w"],
    grid: DrawnGrid,
    light: Light,
    pixels_a_period: float,
) -> tuple[Float32[ndarray, "h w 2"], Float32[ndarray, "h w"]]:
    """Shift of the coordinates, in periods, that moves the drawn pattern onto the image, and their correlation."""
    step = _square_size(pixels_a_period)
    m = _moments(image, light.on(grid.at(coords)), trust, step)
    shift, agreement = _solve(gaussian_means(m, _SHIFT_WINDOW * pixels_a_period / step))
    fit = enlarge(np.dstack([shift, agreement]), image.shape, step)
    return fit[..., :2], fit[..., 2]


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
    means = gaussian_means(m[..., _LIGHT_MOMENTS], _LIGHT_WINDOW * pixels_a_period / step)
    contrast, brightness = _contrast_and_brightness(means)
    light = enlarge(np.dstack([contrast, brightness]), image.shape, step)
    return Light(light[..., 0], light[..., 1])


def _square_size(pixels_a_period: float) -> int:
    """Side of the squares of pixels for which fits are made."""
    return max(1, round(pixels_a_period / _SQUARES))


def _moments(
    image: Float32[ndarray, "h w"], drawn: Float32[ndarray, "h w 3"], trust: Float32[ndarray, "h w"], step: int
) -> Float32[ndarray, "a b 15"]:
    """Products of the pattern, its derivatives and the image, averaged over squares of `step` pixels."""
    h, w = image.shape
    one, p, px, py, i = np.ones_like(image), *np.moveaxis(drawn, -1, 0), image
    products = np.stack(
        [one, p, px, py, p * p, p * px, p * py, px * px, px * py, py * py, i, i * p, i * px, i * py, i * i], -1
    )
    products *= trust[..., None]
    size = (-(-w // step), -(-h // step))
    return np.concatenate([shrink(products[..., k : k + 4], size, step) for k in range(0, 15, 4)], -1)


def _contrast_and_brightness(m: Float32[ndarray, "h w 5"]) -> tuple[Float32[ndarray, "h w"], Float32[ndarray, "h w"]]:
    """By least squares; the contrast is at least a quarter of that in the well lit parts of the image."""
    n = np.maximum(m[..., 0], 1e-6)
    mp, pp, mi, ip = (m[..., k] / n for k in range(1, 5))
    variance = np.maximum(pp - mp * mp, 1e-6)
    contrast = (ip - mi * mp) / variance
    seen = contrast[m[..., 0] > 0.5]
    floor = _LEAST_CONTRAST * float(np.quantile(seen, _WELL_LIT)) if len(seen) else 0.0
    contrast = np.maximum(contrast, max(floor, 1e-3))
    return contrast, mi - contrast * mp


def _solve(m: Float32[ndarray, "h w 15"]) -> tuple[Float32[ndarray, "h w 2"], Float32[ndarray, "h w"]]:
    """Shift by least squares, with brightness and contrast eliminated, and the correlation of image and pattern."""
    n = np.maximum(m[..., 0], 1e-6)
    mp, mx, my, mi = (m[..., k] / n for k in (1, 2, 3, 10))
    pp, xp, yp = m[..., 4] / n - mp * mp, m[..., 5] / n - mp * mx, m[..., 6] / n - mp * my
    xx, xy, yy = m[..., 7] / n - mx * mx, m[..., 8] / n - mx * my, m[..., 9] / n - my * my
    ip, ix, iy = m[..., 11] / n - mi * mp, m[..., 12] / n - mi * mx, m[..., 13] / n - mi * my
    ii = m[..., 14] / n - mi * mi
    pp = np.maximum(pp, 1e-6)
    agreement = ip / np.sqrt(pp * np.maximum(ii, 1e-10))
    # i = b + a p + a (sx px + sy py): eliminate p, then solve 2 x 2 equations for a sx and a sy.
    xx, xy, yy = xx - xp * xp / pp, xy - xp * yp / pp, yy - yp * yp / pp
    ix, iy = ix - xp * ip / pp, iy - yp * ip / pp
    ridge = _PRIOR * (xx + yy) + 1e-6
    xx, yy = xx + ridge, yy + ridge
    determinant = np.maximum(xx * yy - xy * xy, 1e-9)
    contrast = np.maximum(ip / pp, _LEAST_RELATIVE_CONTRAST * np.sqrt(np.maximum(ii, 0) / pp) + 1e-6)
    shift = np.stack([yy * ix - xy * iy, xx * iy - xy * ix], -1) / (determinant * contrast)[..., None]
    trusted = np.clip(agreement, 0, 1)[..., None]  # where the two disagree, their difference is meaningless
    shift = np.clip(shift, -_LARGEST_STEP, _LARGEST_STEP) * trusted
    return shift.astype(np.float32), agreement.astype(np.float32)
