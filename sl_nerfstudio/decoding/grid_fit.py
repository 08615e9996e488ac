"""Coordinates refined on the image itself.

Once it is known which part of the pattern a region shows, the pattern can be drawn there and compared with the capture.
In a Gaussian window about each place, brightness, contrast and a shift of the coordinates are fitted by least squares:
the phases of the network only have to be roughly right.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from sl_nerfstudio.decoding.decoder import Coords, Layer, Mask, large_regions
from sl_nerfstudio.parallel import compiled, parallel, results

# Gaussian means and local planes for images with unknown parts.

_REACH = 2.5  # of a Gaussian window, standard deviations


def gaussian_means(layers: Float32[ndarray, "k h w 4"], sigma: float) -> Float32[ndarray, "k h w 4"]:
    """Gaussian means with zeros outside the image: quotients of two such means are means over the image alone.

    OpenCV is fastest with four channels at a time; there may be any number `k` of such groups.
    """
    radius = int(np.ceil(_REACH * sigma))
    size = (2 * radius + 1, 2 * radius + 1)
    out = np.empty_like(layers)

    def blur(k: int) -> None:
        cv2.GaussianBlur(layers[k], size, sigma, dst=out[k], borderType=cv2.BORDER_CONSTANT)

    parallel([partial(blur, k) for k in range(len(layers))])
    return out


def local_planes(coords: Coords, weights: Layer, sigma: float) -> Coords:
    """The value at each pixel of the plane that fits the values around it, in a Gaussian window, best.

    Values of weight zero may be NaN.
    """
    inside = weights > 0
    if not inside.any():
        return np.full_like(coords, np.nan)
    centre = np.nanmean(coords[inside], axis=0)
    products = np.zeros((3, *inside.shape, 4), dtype=np.float32)
    _multiply(coords, weights, centre, np.float32(sigma), products)
    out = np.empty_like(coords)
    _evaluate_planes(gaussian_means(products, sigma), centre, np.float32(sigma), out)
    return out


def flattened(
    values: Coords,
    inside: Mask,
    weights: Layer,
    windows: Sequence[tuple[float, float]],
    is_near: Callable[[Coords, float], Mask],
) -> Coords:
    """Each pixel on the plane through the largest window that is near its own value, or else as it is.

    `windows` are standard deviations, in pixels and largest first, each with the limit that `is_near` gets beside the
    plane's distance from the value. In narrow parts, and beside edges that were read without a tear, a window holds
    more than one surface: its plane is of none of them. Outside `inside`, values continue the nearest planes.
    `weights` are those of the pixels in a plane, zero outside.
    """
    out = values
    for sigma, limit in reversed(windows):
        plane = local_planes(values, weights, sigma)
        near = ~inside | is_near(plane - values, limit)
        out = np.where(near[..., None], plane, out)
    return out


@compiled
def _multiply(coords: ndarray, weights: ndarray, centre: ndarray, sigma: float, out: ndarray) -> None:
    """Weighted products of one, place and coordinates: (1, x, y, xx), (xy, yy, u, ux), (uy, v, vx, vy)."""
    h, w = weights.shape
    for row in range(h):
        y = (row - h / 2) / sigma
        for column in range(w):
            n = weights[row, column]
            if n > 0:
                x = (column - w / 2) / sigma
                u, v = n * (coords[row, column, 0] - centre[0]), n * (coords[row, column, 1] - centre[1])
                a, b, c = out[0, row, column], out[1, row, column], out[2, row, column]
                a[0], a[1], a[2], a[3] = n, n * x, n * y, n * x * x
                b[0], b[1], b[2], b[3] = n * x * y, n * y * y, u, u * x
                c[0], c[1], c[2], c[3] = u * y, v, v * x, v * y


@compiled
def _evaluate_planes(means: ndarray, centre: ndarray, sigma: float, out: ndarray) -> None:
    """Planes from moments about the pixel itself, where they are evaluated."""
    h, w = out.shape[:2]
    for row in range(h):
        y = (row - h / 2) / sigma
        for column in range(w):
            x = (column - w / 2) / sigma
            a, b, c = means[0, row, column], means[1, row, column], means[2, row, column]
            n = max(a[0], np.float32(1e-6))
            mx, my = a[1] / n, a[2] / n
            sxx, sxy, syy = a[3] / n - mx * mx + 1e-3, b[0] / n - mx * my, b[1] / n - my * my + 1e-3
            determinant = sxx * syy - sxy * sxy
            for axis in range(2):
                if axis == 0:
                    mean, vx, vy = b[2] / n, b[3] / n, c[0] / n
                else:
                    mean, vx, vy = c[1] / n, c[2] / n, c[3] / n
                cx, cy = vx - mean * mx, vy - mean * my
                slope_x, slope_y = (syy * cx - sxy * cy) / determinant, (sxx * cy - sxy * cx) / determinant
                out[row, column, axis] = centre[axis] + mean + slope_x * (x - mx) + slope_y * (y - my)


def enlarge(stack: Float32[ndarray, "a b k"], shape: tuple[int, ...], step: int) -> Float32[ndarray, "h w k"]:
    """Bilinear values, at the pixels of an image of the given `shape`, of results for squares of `step` pixels."""
    affine = np.array([[1 / step, 0, 0.5 / step - 0.5], [0, 1 / step, 0.5 / step - 0.5]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(stack, affine, (shape[1], shape[0]), borderMode=cv2.BORDER_REPLICATE, flags=flags)


# The pattern as it should appear in an image: drawn at several degrees of sharpness, under uneven light.

_BLURS = (0.045, 0.1, 0.18)  # periods


@dataclass(frozen=True)
class DrawnGrid:
    """The pattern at one sharpness: values and derivatives by x and y, per period."""

    layers: Float32[ndarray, "h w 3"]
    period: float

    def at(self, coords: Coords) -> Float32[ndarray, "h w 3"]:
        """Bilinear values at pattern pixels."""
        place = np.nan_to_num(coords) - np.float32(0.5)
        return cv2.remap(self.layers, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def draw_sharpnesses(picture: Layer, period: float) -> tuple[DrawnGrid, ...]:
    """The pattern as it appears through lenses of different sharpness."""
    drawn = []
    for blur in _BLURS:
        soft = cv2.GaussianBlur(picture, (0, 0), blur * period)
        gy, gx = np.gradient(soft)
        drawn.append(DrawnGrid(np.stack([soft, gx * period, gy * period], -1).astype(np.float32), period))
    return tuple(drawn)


@dataclass(frozen=True)
class GridLight:
    """Light that a pattern value of one adds at each pixel, and light without the pattern.

    On a surface that gets darker to one side, a line compared with an evenly lit one would seem shifted to the other
    side.
    """

    contrast: Layer
    brightness: Layer

    @staticmethod
    def even(shape: tuple[int, ...]) -> "GridLight":
        """Contrast one everywhere, and no light without the pattern."""
        return GridLight(np.ones(shape, dtype=np.float32), np.zeros(shape, dtype=np.float32))

    def on(self, drawn: Float32[ndarray, "h w 3"]) -> Float32[ndarray, "h w 3"]:
        """The drawn pattern and its derivatives as they should appear in the image."""
        lit = drawn * self.contrast[..., None]
        lit[..., 0] += self.brightness
        return lit


# One least-squares step of the dense fit: light, and shift of the coordinates, in a window about each place.
#
# Lucas and Kanade (1981), with brightness and contrast as further unknowns. All sums that the normal equations need
# are moments of the image, the drawn pattern and its derivatives.

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
    """Shift that moves the drawn pattern onto the image at each pixel."""

    shift: Coords  # of the coordinates, periods
    agreement: Layer  # correlation of image and pattern
    variance: Layer  # of the shift along either axis if pixels err independently, periods squared


def fit_shift(
    image: Layer, coords: Coords, trust: Layer, grid: DrawnGrid, light: GridLight, pixels_a_period: float, window: float
) -> ShiftFit:
    """The fit in a Gaussian window about each pixel, whose standard deviation is `window` periods."""
    step = _square_size(pixels_a_period)
    m = _moments(image, light.on(grid.at(coords)), trust, step)
    found = np.empty((*m.shape[1:3], 4), dtype=np.float32)
    sigma = window * pixels_a_period
    _solve(gaussian_means(m, sigma / step), np.float32(4 * np.pi * sigma**2), found)
    fit = enlarge(found, image.shape, step)
    return ShiftFit(fit[..., :2], fit[..., 2], fit[..., 3])


def measure_light(image: Layer, coords: Coords, trust: Layer, grid: DrawnGrid, pixels_a_period: float) -> GridLight:
    """The light in the image by least squares, from coordinates that are nearly right.

    The contrast is at least a quarter of that of well lit parts.
    """
    step = _square_size(pixels_a_period)
    m = gaussian_means(_moments(image, grid.at(coords), trust, step)[:2], _LIGHT_WINDOW * pixels_a_period / step)
    n = np.maximum(m[0, ..., 0], 1e-6)
    mp, pp, mi, ip = m[0, ..., 1] / n, m[0, ..., 2] / n, m[0, ..., 3] / n, m[1, ..., 0] / n
    contrast = (ip - mi * mp) / np.maximum(pp - mp * mp, 1e-6)
    seen = contrast[m[0, ..., 0] > 0.5]
    floor = _LEAST_CONTRAST * float(np.quantile(seen, _WELL_LIT)) if len(seen) else 0.0
    contrast = np.maximum(contrast, max(floor, 1e-3))
    light = enlarge(np.dstack([contrast, mi - contrast * mp]), image.shape, step)
    return GridLight(light[..., 0], light[..., 1])


def _square_size(pixels_a_period: float) -> int:
    """Side of the squares of pixels for which fits are made."""
    return max(1, round(pixels_a_period / _SQUARES))


def _moments(image: Layer, drawn: Float32[ndarray, "h w 3"], trust: Layer, step: int) -> Float32[ndarray, "4 a b 4"]:
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


# Regions.
_TEAR = 0.35  # periods between neighbouring pixels
_LEAST_AREA = 1.0  # smaller regions are left out, periods squared
# Iteration.
_WINDOW = 0.42  # of a shift, periods
_ROUNDS = 6  # each recovers a part of the detail that the window of the fit averages over
_SMOOTHING = ((0.35, 0.05), (0.12, 0.1))  # windows in which coordinates are taken to be linear, and how far from them
# the pixel's own may be for that; periods
_LARGEST_SHIFT = 0.12  # periods, of all rounds together


def fit_densely(
    image: Layer, coords: Coords, trust: Layer, grids: tuple[DrawnGrid, ...], pixels_a_period: float
) -> tuple[Coords, Layer]:
    """Refined coordinates in pattern pixels, and the correlation of pattern and image there (-1 to 1).

    `trust` is the weight of each pixel, from 0 to 1: in a shadow the image must not pull at the pattern.
    `coords` may be off by a quarter of a period; regions smaller than a period squared are left out.
    """
    out = np.full_like(coords, np.nan)
    agreement = np.zeros(image.shape, dtype=np.float32)
    least = _LEAST_AREA * pixels_a_period**2
    for box, inside in large_regions(coords, _TEAR * grids[0].period, least):
        values, fit = _refine(image[box], coords[box], trust[box] * inside, inside, grids, pixels_a_period)
        out[box][inside], agreement[box][inside] = values[inside], fit[inside]
    return out, agreement


def _refine(
    image: Layer, coords: Coords, trust: Layer, inside: Mask, grids: tuple[DrawnGrid, ...], pixels_a_period: float
) -> tuple[Coords, Layer]:
    """A few rounds of fitting shifts, with the sharpness that agrees best with the image.

    Outside `inside`, values continue the nearest planes.
    """
    period = grids[0].period
    coords = _smooth(coords, inside, pixels_a_period, period)
    start, even = coords, GridLight.even(image.shape)
    fits = results([partial(fit_shift, image, coords, trust, grid, even, pixels_a_period, _WINDOW) for grid in grids])
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


def _smooth(coords: Coords, inside: Mask, pixels_a_period: float, period: float) -> Coords:
    """Smooth coordinates on planes that are near each pixel's own coordinates."""

    def is_near(apart: Coords, limit: float) -> Mask:
        return apart[..., 0] ** 2 + apart[..., 1] ** 2 < (limit * period) ** 2

    windows = [(window * pixels_a_period, limit) for window, limit in _SMOOTHING]
    return flattened(coords, inside, inside.astype(np.float32), windows, is_near)
