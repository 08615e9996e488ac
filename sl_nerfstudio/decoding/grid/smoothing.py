"""Gaussian means, local planes and changes of resolution for images with unknown parts."""

import cv2
import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

_REACH = 2.5  # of a Gaussian window, standard deviations


def gaussian_means(stack: Float32[ndarray, "h w k"], sigma: float) -> Float32[ndarray, "h w k"]:
    """Gaussian means with zeros outside the image: quotients of two such means are means over the image alone."""
    radius = int(np.ceil(_REACH * sigma))
    size = (2 * radius + 1, 2 * radius + 1)
    parts = [stack[..., k : k + 4] for k in range(0, stack.shape[-1], 4)]
    blurred = [
        np.atleast_3d(cv2.GaussianBlur(np.ascontiguousarray(p), size, sigma, borderType=cv2.BORDER_CONSTANT))
        for p in parts
    ]
    return np.concatenate(blurred, -1)


def local_planes(
    coords: Float32[ndarray, "h w 2"], inside: Bool[ndarray, "h w"], sigma: float
) -> Float32[ndarray, "h w 2"]:
    """The value at each pixel of the plane that fits the values around it, in a Gaussian window, best."""
    h, w = inside.shape
    y, x = np.mgrid[:h, :w].astype(np.float32)
    x, y = (x - w / 2) / np.float32(sigma), (y - h / 2) / np.float32(sigma)
    weight = inside.astype(np.float32)
    centre = np.nanmean(coords[inside], axis=0)
    value = np.where(inside[..., None], coords - centre, 0).astype(np.float32)
    products = [weight, weight * x, weight * y, weight * x * x, weight * x * y, weight * y * y]
    products += [value[..., 0] * f for f in (1, x, y)] + [value[..., 1] * f for f in (1, x, y)]
    m = gaussian_means(np.stack(products, -1), sigma)
    # Moments about the pixel itself, where the plane is evaluated.
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
