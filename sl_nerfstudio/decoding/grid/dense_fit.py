"""Coordinates sharpened on the image itself.

Once it is known which part of the pattern a region shows, the pattern can be drawn there and compared with the
capture. In a Gaussian window about each place, brightness, contrast and a shift of the coordinates are fitted by
least squares (Lucas and Kanade 1981): the phases of the network only need to be near.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray
from scipy.ndimage import find_objects

from sl_nerfstudio.compiled import compiled

_BLURS = (0.045, 0.1, 0.18)  # of the drawn pattern, periods
_SMOOTHING = 0.35  # window over which coordinates are taken for linear, periods
_WINDOW = 0.42  # of the fit, periods
_LIGHT = 0.38  # window over which the light is taken for even, periods
_OF_LIGHT = [0, 1, 4, 10, 11]  # moments that contrast and brightness follow from
_ROUNDS = 4
_LARGEST_SHIFT = 0.25  # periods, of all rounds together
_PRIOR = 0.02  # a shift of one period weighs as much as this share of the window's contrast
_TEAR = 0.35  # periods between neighbouring pixels
_PLACES = 8  # a period, where fits are made
_FINEST = 12.0  # pixels a period: finer captures are averaged first
_LEAST_AREA = 1.0  # smaller regions are left out, periods squared


@dataclass(frozen=True)
class DrawnGrid:
    """The pattern at one sharpness: values and derivatives by x and y, per period."""

    layers: Float32[ndarray, "h w 3"]
    period: float

    def at(self, coords: Float32[ndarray, "h w 2"]) -> Float32[ndarray, "h w 3"]:
        """Bilinear look-up at pattern pixels."""
        place = np.nan_to_num(coords) - np.float32(0.5)
        return cv2.remap(self.layers, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


@dataclass(frozen=True)
class Light:
    """What a pattern value of one adds to a pixel, and what is there without it.

    A line on a surface that darkens to one side would seem shifted to the other, were it compared with an even one.
    """

    contrast: Float32[ndarray, "h w"]
    brightness: Float32[ndarray, "h w"]

    @staticmethod
    def even(shape: tuple[int, ...]) -> "Light":
        """One everywhere, nothing without the pattern."""
        return Light(np.ones(shape, dtype=np.float32), np.zeros(shape, dtype=np.float32))

    def on(self, drawn: Float32[ndarray, "h w 3"]) -> Float32[ndarray, "h w 3"]:
        """The drawn pattern and its derivatives as the image should show them."""
        lit = drawn * self.contrast[..., None]
        lit[..., 0] += self.brightness
        return lit


def draw_sharpnesses(picture: Float32[ndarray, "h w"], period: float) -> tuple[DrawnGrid, ...]:
    """The pattern as lenses of different sharpness show it."""
    drawn = []
    for blur in _BLURS:
        soft = cv2.GaussianBlur(picture, (0, 0), blur * period)
        gy, gx = np.gradient(soft)
        drawn.append(DrawnGrid(np.stack([soft, gx * period, gy * period], -1).astype(np.float32), period))
    return tuple(drawn)


def fit_densely(
    image: Float32[ndarray, "h w"],
    coords: Float32[ndarray, "h w 2"],
    grids: tuple[DrawnGrid, ...],
    pixels_a_period: float,
) -> tuple[Float32[ndarray, "h w 2"], Float32[ndarray, "h w"]]:
    """Coordinates in pattern pixels, sharpened, and how well pattern and image agree there (correlation, -1 to 1)."""
    out = np.full_like(coords, np.nan)
    agreement = np.zeros(image.shape, dtype=np.float32)
    factor = max(1, int(pixels_a_period / _FINEST))
    least = _LEAST_AREA * pixels_a_period**2
    for box, inside in _regions(coords, grids[0].period):
        if inside.sum() < least:
            continue
        coarse = _coarser(image[box], coords[box], inside, factor)
        values, fit = _sharpen(*coarse, grids, pixels_a_period / factor)
        values, fit = _finer(values, inside.shape, factor), _finer(fit, inside.shape, factor)
        out[box][inside], agreement[box][inside] = values[inside], fit[inside]
    return out, agreement


def _coarser(
    image: Float32[ndarray, "h w"], coords: Float32[ndarray, "h w 2"], inside: Bool[ndarray, "h w"], factor: int
) -> tuple[Float32[ndarray, "a b"], Float32[ndarray, "a b 2"], Bool[ndarray, "a b"]]:
    """Means over squares of `factor` pixels: fine captures are fitted faster, and no worse."""
    if factor == 1:
        return image, coords, inside
    h, w = inside.shape
    size = (-(-w // factor), -(-h // factor))
    weight = inside.astype(np.float32)
    values = np.where(inside[..., None], coords, 0)
    mean = _shrink(np.dstack([weight, image * weight, values]).astype(np.float32), size, factor)
    known = np.maximum(mean[..., :1], 1e-6)
    mean[..., 1:] /= known
    return mean[..., 1].copy(), mean[..., 2:].copy(), mean[..., 0] > 0.3


def _finer(values: Float32[ndarray, "a b *c"], shape: tuple[int, ...], factor: int) -> Float32[ndarray, "h w *c"]:
    """Bilinear values at the pixels that `_coarser` averaged."""
    if factor == 1:
        return values
    size = values.shape[1] * factor, values.shape[0] * factor
    return cv2.resize(values, size, interpolation=cv2.INTER_LINEAR)[: shape[0], : shape[1]]


def _regions(
    coords: Float32[ndarray, "h w 2"], period: float
) -> Iterator[tuple[tuple[slice, slice], Bool[ndarray, "a b"]]]:
    """Connected parts without a tear: a box each, and the pixels of it."""
    number = np.zeros(coords.shape[:2], dtype=np.int32)
    _number_regions(coords, _TEAR * period, number)
    for index, box in enumerate(find_objects(number), 1):
        yield box, number[box] == index


@compiled
def _number_regions(coords: ndarray, tear: float, number: ndarray) -> None:
    """Fill `number`: 0 where unknown, else 1, 2, .. by region."""
    h, w = number.shape
    stack = np.empty((h * w, 2), dtype=np.int32)
    regions = 0
    for row in range(h):
        for column in range(w):
            if number[row, column] != 0 or np.isnan(coords[row, column, 0]):
                continue
            regions += 1
            number[row, column] = regions
            stack[0, 0], stack[0, 1] = row, column
            top = 1
            while top > 0:
                top -= 1
                r, c = stack[top, 0], stack[top, 1]
                for d in range(4):
                    rr = r + (d == 1) - (d == 3)
                    cc = c + (d == 0) - (d == 2)
                    if rr < 0 or cc < 0 or rr >= h or cc >= w or number[rr, cc] != 0:
                        continue
                    dx = abs(coords[rr, cc, 0] - coords[r, c, 0])
                    dy = abs(coords[rr, cc, 1] - coords[r, c, 1])
                    if dx <= tear and dy <= tear:  # false for NaN
                        number[rr, cc] = regions
                        stack[top, 0], stack[top, 1] = rr, cc
                        top += 1


def _linear_fit(
    coords: Float32[ndarray, "h w 2"], inside: Bool[ndarray, "h w"], sigma: float
) -> Float32[ndarray, "h w 2"]:
    """Each pixel's value on the plane that fits the values around it best."""
    h, w = inside.shape
    y, x = np.mgrid[:h, :w].astype(np.float32)
    x, y = (x - w / 2) / np.float32(sigma), (y - h / 2) / np.float32(sigma)
    weight = inside.astype(np.float32)
    centre = np.nanmean(coords[inside], axis=0)
    value = np.where(inside[..., None], coords - centre, 0).astype(np.float32)
    products = [weight, weight * x, weight * y, weight * x * x, weight * x * y, weight * y * y]
    products += [value[..., 0] * f for f in (1, x, y)] + [value[..., 1] * f for f in (1, x, y)]
    m = _blur(np.stack(products, -1), sigma)
    # moments about the pixel itself, where the plane's height is asked for
    n = np.maximum(m[..., 0], 1e-6)
    mx, my = m[..., 1] / n, m[..., 2] / n
    sxx, sxy, syy = m[..., 3] / n - mx * mx + 1e-3, m[..., 4] / n - mx * my, m[..., 5] / n - my * my + 1e-3
    determinant = sxx * syy - sxy * sxy
    out = np.empty_like(value)
    for axis in range(2):
        mean, vx, vy = (m[..., 6 + 3 * axis + k] / n for k in range(3))
        cx, cy = vx - mean * mx, vy - mean * my
        slope_x, slope_y = (syy * cx - sxy * cy) / determinant, (sxx * cy - sxy * cx) / determinant
        out[..., axis] = mean + slope_x * (x - mx) + slope_y * (y - my)
    return (out + centre).astype(np.float32)


def _blur(stack: Float32[ndarray, "h w k"], sigma: float) -> Float32[ndarray, "h w k"]:
    """Gaussian means; zero beyond the rim, so that quotients of means are means over what is there."""
    radius = int(np.ceil(2.5 * sigma))
    size = (2 * radius + 1, 2 * radius + 1)
    parts = [stack[..., k : k + 4] for k in range(0, stack.shape[-1], 4)]
    blurred = [
        np.atleast_3d(cv2.GaussianBlur(np.ascontiguousarray(p), size, sigma, borderType=cv2.BORDER_CONSTANT))
        for p in parts
    ]
    return np.concatenate(blurred, -1)


def _sharpen(
    image: Float32[ndarray, "h w"],
    coords: Float32[ndarray, "h w 2"],
    inside: Bool[ndarray, "h w"],
    grids: tuple[DrawnGrid, ...],
    pixels_a_period: float,
) -> tuple[Float32[ndarray, "h w 2"], Float32[ndarray, "h w"]]:
    """A few rounds of fitting shifts; the sharpness that agrees best with the image is kept.

    Values are given beyond `inside` too, as the nearest planes run on.
    """
    if not inside.any():
        return np.full_like(coords, np.nan), np.zeros_like(image)
    coords, period = _linear_fit(coords, inside, _SMOOTHING * pixels_a_period), grids[0].period
    start, even = coords, Light.even(image.shape)
    fits = [_fit_shift(image, coords, inside, grid, even, pixels_a_period) for grid in grids]
    best = int(np.argmax([fit[1][inside].mean() for fit in fits]))
    shift, light = fits[best][0], _see_light(image, coords, inside, grids[best], pixels_a_period)
    for index in range(_ROUNDS):
        moved = coords + shift * np.float32(period) - start
        limit = np.float32(_LARGEST_SHIFT * period)
        coords = start + np.clip(moved, -limit, limit)
        if index == 0:  # what is left of the network's noise; smoothing after every round would flatten the surface
            coords = _linear_fit(coords, inside, _SMOOTHING * pixels_a_period)
        shift, _ = _fit_shift(image, coords, inside, grids[best], light, pixels_a_period)
    # Judged in even light: what the light was bent to explain must not count as agreement.
    return coords, _fit_shift(image, coords, inside, grids[best], even, pixels_a_period)[1]


def _fit_shift(
    image: Float32[ndarray, "h w"],
    coords: Float32[ndarray, "h w 2"],
    inside: Bool[ndarray, "h w"],
    grid: DrawnGrid,
    light: Light,
    pixels_a_period: float,
) -> tuple[Float32[ndarray, "h w 2"], Float32[ndarray, "h w"]]:
    """Shift of the coordinates, in periods, that brings the drawn and lit pattern onto the image; their correlation."""
    step = _step(pixels_a_period)
    m = _moments(image, light.on(grid.at(coords)), inside, step)
    shift, agreement = _solve(_blur(m, _WINDOW * pixels_a_period / step))
    fit = _back(np.dstack([shift, agreement]), image.shape, step)
    return fit[..., :2], fit[..., 2]


def _see_light(
    image: Float32[ndarray, "h w"],
    coords: Float32[ndarray, "h w 2"],
    inside: Bool[ndarray, "h w"],
    grid: DrawnGrid,
    pixels_a_period: float,
) -> Light:
    """The light that the image shows where the coordinates are nearly right."""
    step = _step(pixels_a_period)
    m = _moments(image, grid.at(coords), inside, step)
    contrast, brightness = _contrast_and_brightness(_blur(m[..., _OF_LIGHT], _LIGHT * pixels_a_period / step))
    seen = _back(np.dstack([contrast, brightness]), image.shape, step)
    return Light(seen[..., 0], seen[..., 1])


def _step(pixels_a_period: float) -> int:
    """Pixels between the places where fits are made."""
    return max(1, round(pixels_a_period / _PLACES))


def _moments(
    image: Float32[ndarray, "h w"], drawn: Float32[ndarray, "h w 3"], inside: Bool[ndarray, "h w"], step: int
) -> Float32[ndarray, "a b 15"]:
    """Products of pattern, its derivatives and image, averaged over squares of `step` pixels."""
    h, w = image.shape
    weight = inside.astype(np.float32)
    p, px, py = (drawn[..., k] * weight for k in range(3))
    i = image * weight
    products = np.stack(
        [weight, p, px, py, p * p, p * px, p * py, px * px, px * py, py * py, i, i * p, i * px, i * py, i * i], -1
    )
    size = (-(-w // step), -(-h // step))
    return np.concatenate([_shrink(products[..., k : k + 4], size, step) for k in range(0, 15, 4)], -1)


def _back(stack: Float32[ndarray, "a b k"], shape: tuple[int, ...], step: int) -> Float32[ndarray, "h w k"]:
    """Bilinear values at the image's pixels of what was found for squares of `step` pixels."""
    affine = np.array([[1 / step, 0, 0.5 / step - 0.5], [0, 1 / step, 0.5 / step - 0.5]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(stack, affine, (shape[1], shape[0]), borderMode=cv2.BORDER_REPLICATE, flags=flags)


def _shrink(stack: Float32[ndarray, "h w k"], size: tuple[int, int], step: int) -> Float32[ndarray, "a b k"]:
    """Means over squares of `step` pixels; zeros are added where the last square reaches beyond."""
    h, w = stack.shape[:2]
    full = cv2.copyMakeBorder(np.ascontiguousarray(stack), 0, size[1] * step - h, 0, size[0] * step - w,
                              cv2.BORDER_CONSTANT)  # fmt: skip
    return np.atleast_3d(cv2.resize(full, size, interpolation=cv2.INTER_AREA))


def _contrast_and_brightness(m: Float32[ndarray, "h w 5"]) -> tuple[Float32[ndarray, "h w"], Float32[ndarray, "h w"]]:
    """By least squares; the contrast is kept above a quarter of that of the image's well lit parts."""
    n = np.maximum(m[..., 0], 1e-6)
    mp, pp, mi, ip = (m[..., k] / n for k in range(1, 5))
    variance = np.maximum(pp - mp * mp, 1e-6)
    contrast = (ip - mi * mp) / variance
    seen = contrast[m[..., 0] > 0.5]
    floor = 0.25 * float(np.quantile(seen, 0.9)) if len(seen) else 0.0
    contrast = np.maximum(contrast, max(floor, 1e-3))
    return contrast, mi - contrast * mp


def _solve(m: Float32[ndarray, "h w 15"]) -> tuple[Float32[ndarray, "h w 2"], Float32[ndarray, "h w"]]:
    """Least squares for the shift; brightness and contrast are eliminated with the moments. Also the correlation."""
    n = np.maximum(m[..., 0], 1e-6)
    mp, mx, my, mi = (m[..., k] / n for k in (1, 2, 3, 10))
    pp, xp, yp = m[..., 4] / n - mp * mp, m[..., 5] / n - mp * mx, m[..., 6] / n - mp * my
    xx, xy, yy = m[..., 7] / n - mx * mx, m[..., 8] / n - mx * my, m[..., 9] / n - my * my
    ip, ix, iy = m[..., 11] / n - mi * mp, m[..., 12] / n - mi * mx, m[..., 13] / n - mi * my
    ii = m[..., 14] / n - mi * mi
    pp = np.maximum(pp, 1e-6)
    agreement = ip / np.sqrt(pp * np.maximum(ii, 1e-10))
    # i = b + a p + a (sx px + sy py): take p's share out of all, then solve 2 x 2 for a sx, a sy
    xx, xy, yy = xx - xp * xp / pp, xy - xp * yp / pp, yy - yp * yp / pp
    ix, iy = ix - xp * ip / pp, iy - yp * ip / pp
    ridge = _PRIOR * (xx + yy) + 1e-6
    xx, yy = xx + ridge, yy + ridge
    determinant = np.maximum(xx * yy - xy * xy, 1e-9)
    contrast = np.maximum(ip / pp, 0.05 * np.sqrt(np.maximum(ii, 0) / pp) + 1e-6)
    shift = np.stack([yy * ix - xy * iy, xx * iy - xy * ix], -1) / (determinant * contrast)[..., None]
    trusted = np.clip(agreement, 0, 1)[..., None]  # where the two do not agree, their difference tells nothing
    shift = np.clip(shift, -0.2, 0.2) * trusted
    return shift.astype(np.float32), agreement.astype(np.float32)
