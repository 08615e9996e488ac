"""How large a period of the pattern is in an image, and coordinates at another resolution."""

import cv2
import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from sl_nerfstudio.decoding.grid.edges.continuation import slopes

_TEAR = 0.35  # periods between neighbouring pixels
_FEWEST = 100  # pixels from which a size is told


def pixels_a_period(coords: Float32[ndarray, "h w 2"], period: float) -> float | None:
    """Pixels of the image in a period of the pattern, median; None where hardly anything is decoded."""
    by_x, by_y = np.diff(coords[:-1], axis=1), np.diff(coords[:, :-1], axis=0)
    smooth = np.ones(by_x.shape[:2], dtype=bool)
    for step in (by_x, by_y):
        for part in (step[..., 0], step[..., 1]):  # numpy takes the larger of two far more slowly
            smooth &= np.abs(part) < _TEAR * period
    area = np.abs(by_x[..., 0] * by_y[..., 1] - by_x[..., 1] * by_y[..., 0])[smooth]
    area = area[area > 0]
    return period / float(np.sqrt(np.median(area))) if len(area) >= _FEWEST else None


def enlarged(
    coords: Float32[ndarray, "a b 2"], factor: int, shape: tuple[int, int], period: float
) -> Float32[ndarray, "h w 2"]:
    """Coordinates at the pixels of an image of the given shape; those given are at squares of `factor` of its pixels.

    Bilinear within a surface; at its border, the square's plane is continued. NaN where a pixel's square has none.
    """
    if factor == 1:
        return coords
    h, w = shape
    size = coords.shape[1] * factor, coords.shape[0] * factor
    near = np.repeat(np.repeat(coords, factor, axis=0), factor, axis=1)
    slope = np.repeat(np.repeat(slopes(coords, period), factor, axis=0), factor, axis=1)
    place = ((np.arange(factor) + 0.5) / factor - 0.5).astype(np.float32)
    x, y = np.tile(place, coords.shape[1])[None, :, None], np.tile(place, coords.shape[0])[:, None, None]
    plane = near + slope[..., 0] * x + slope[..., 1] * y
    linear = cv2.resize(coords, size, interpolation=cv2.INTER_LINEAR)  # NaN beside what is unknown
    smooth = np.abs(linear - near).max(-1, keepdims=True) < _TEAR * period
    half = factor // 2  # beside the image's border, where interpolation has one side only
    smooth[:half], smooth[-half:], smooth[:, :half], smooth[:, -half:] = False, False, False, False
    whole = np.where(smooth, linear, np.where(np.isfinite(plane), plane, near))
    out = np.full((h, w, 2), np.nan, dtype=np.float32)
    out[: size[1], : size[0]] = np.where(np.isfinite(near), whole, np.float32(np.nan))
    return out
