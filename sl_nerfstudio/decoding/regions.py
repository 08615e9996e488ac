"""Connected regions of a coordinate image, and the tears between them: small regions are decoding errors."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float32, Int32
from numpy import ndarray
from scipy.ndimage import find_objects

from sl_nerfstudio.compiled import compiled


def drop_small_regions(
    coords: Float32[ndarray, "h w 2"], largest_step: float, least_pixels: int
) -> Float32[ndarray, "h w 2"]:
    """Set connected regions of fewer than `least_pixels` pixels to NaN; `largest_step` as in `number_regions`."""
    number = number_regions(coords, largest_step)
    small = np.bincount(number.ravel(), minlength=1) < least_pixels
    return np.where(small[number][..., None], np.float32(np.nan), coords)


def large_regions(
    coords: Float32[ndarray, "h w 2"], largest_step: float, least_pixels: float
) -> Iterator[tuple[tuple[slice, slice], Bool[ndarray, "a b"]]]:
    """Regions of at least `least_pixels` pixels: the bounding box of each, and its pixels within the box."""
    number = number_regions(coords, largest_step)
    area = np.bincount(number.ravel())
    for index, box in enumerate(find_objects(number), 1):
        if area[index] >= least_pixels:
            yield box, number[box] == index


def torn(coords: Float32[ndarray, "h w 2"], largest_step: float) -> Bool[ndarray, "h w"]:
    """Pixels on both sides of a step of either coordinate larger than `largest_step`; one to NaN is none."""
    out = np.zeros(coords.shape[:2], dtype=np.bool_)
    _mark_torn(coords, np.float32(largest_step), out)
    return out


def number_regions(coords: Float32[ndarray, "h w 2"], largest_step: float) -> Int32[ndarray, "h w"]:
    """Connected regions, numbered from 1 in the order of their first pixels; 0 where nothing is decoded.

    Neighbouring pixels (4 directions) are connected if both are decoded and neither coordinate differs by more than
    `largest_step`.
    """
    number = np.zeros(coords.shape[:2], dtype=np.int32)
    _fill(coords, largest_step, number)
    return number


@compiled
def _fill(coords: ndarray, tear: float, number: ndarray) -> None:
    """Fill `number`: 0 where coordinates are unknown, otherwise 1, 2, .. by region."""
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


@compiled
def _mark_torn(coords: ndarray, largest: float, out: ndarray) -> None:
    h, w = out.shape
    for row in range(h):
        for column in range(w):
            for r, c in ((row + 1, column), (row, column + 1)):
                if r >= h or c >= w:
                    continue
                dx, dy = coords[r, c, 0] - coords[row, column, 0], coords[r, c, 1] - coords[row, column, 1]
                if abs(dx) > largest or abs(dy) > largest:  # False for NaN
                    out[row, column] = out[r, c] = True
