"""Gaussian means, local planes and changes of resolution for images with unknown parts."""

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

from sl_nerfstudio.compiled import compiled

_REACH = 2.5  # of a Gaussian window, standard deviations


def gaussian_means(layers: Float32[ndarray, "k h w 4"], sigma: float) -> Float32[ndarray, "k h w 4"]:
    """Gaussian means with zeros outside the image: quotients of two such means are means over the image alone.

    OpenCV is fastest with four channels at a time; there may be any number `k` of such groups.
    """
    radius = int(np.ceil(_REACH * sigma))
    size = (2 * radius + 1, 2 * radius + 1)
    out = np.empty_like(layers)
    for group, means in zip(layers, out, strict=True):
        cv2.GaussianBlur(group, size, sigma, dst=means, borderType=cv2.BORDER_CONSTANT)
    return out


def local_planes(
    coords: Float32[ndarray, "h w 2"], inside: Bool[ndarray, "h w"], sigma: float
) -> Float32[ndarray, "h w 2"]:
    """The value at each pixel of the plane that fits the values around it, in a Gaussian window, best."""
    if not inside.any():
        return np.full_like(coords, np.nan)
    centre = np.nanmean(coords[inside], axis=0)
    products = np.zeros((3, *inside.shape, 4), dtype=np.float32)
    _multiply(coords, inside, centre, np.float32(sigma), products)
    out = np.empty_like(coords)
    _evaluate_planes(gaussian_means(products, sigma), centre, np.float32(sigma), out)
    return out


def flattened(
    values: Float32[ndarray, "h w 2"],
    inside: Bool[ndarray, "h w"],
    windows: Sequence[tuple[float, float]],
    is_near: Callable[[Float32[ndarray, "h w 2"], float], Bool[ndarray, "h w"]],
) -> Float32[ndarray, "h w 2"]:
    """Each pixel on the plane through the largest window that is near its own value, or else as it is.

    `windows` are standard deviations, in pixels and largest first, each with the limit that `is_near` gets beside the
    plane's distance from the value. In narrow parts, and beside edges that were read without a tear, a window holds
    more than one surface: its plane is of none of them. Outside `inside`, values continue the nearest planes.
    """
    out = values
    for sigma, limit in reversed(windows):
        plane = local_planes(values, inside, sigma)
        near = ~inside | is_near(plane - values, limit)
        out = np.where(near[..., None], plane, out)
    return out


@compiled
def _multiply(coords: ndarray, inside: ndarray, centre: ndarray, sigma: float, out: ndarray) -> None:
    """Products of one, place and coordinates at the pixels inside: (1, x, y, xx), (xy, yy, u, ux), (uy, v, vx, vy)."""
    h, w = inside.shape
    for row in range(h):
        y = (row - h / 2) / sigma
        for column in range(w):
            if inside[row, column]:
                x = (column - w / 2) / sigma
                u, v = coords[row, column, 0] - centre[0], coords[row, column, 1] - centre[1]
                a, b, c = out[0, row, column], out[1, row, column], out[2, row, column]
                a[0], a[1], a[2], a[3] = 1, x, y, x * x
                b[0], b[1], b[2], b[3] = x * y, y * y, u, u * x
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


def shrink(stack: Float32[ndarray, "h w k"], size: tuple[int, int], step: int) -> Float32[ndarray, "a b k"]:
    """Means over squares of `step` pixels; the image continues with zeros where the last squares need it."""
    h, w = stack.shape[:2]
    full = cv2.copyMakeBorder(np.ascontiguousarray(stack), 0, size[1] * step - h, 0, size[0] * step - w,
                              cv2.BORDER_CONSTANT)  # fmt: skip
    return np.atleast_3d(cv2.resize(full, size, interpolation=cv2.INTER_AREA))


def enlarge(stack: Float32[ndarray, "a b k"], shape: tuple[int, ...], step: int) -> Float32[ndarray, "h w k"]:
    """Bilinear values, at the pixels of an image of the given `shape`, of results for squares of `step` pixels."""
    affine = np.array([[1 / step, 0, 0.5 / step - 0.5], [0, 1 / step, 0.5 / step - 0.5]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(stack, affine, (shape[1], shape[0]), borderMode=cv2.BORDER_REPLICATE, flags=flags)
