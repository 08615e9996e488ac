"""Coordinates from shifted sines: each gives the coordinate modulo its period; bits or longer sines say which one."""

import numpy as np
from jaxtyping import Float32, Int32
from numpy import ndarray

from sl_nerfstudio.decoding.graycode.photographs import Photographs
from sl_nerfstudio.decoding.graycode.subcell import Cells
from sl_nerfstudio.pattern.graycode import gray

_PIXEL_CENTRE = 0.5  # the sine is at its crest where the first pixel's centre is
_LEAST_AMPLITUDE = 4.0  # times its own noise


def cell_places(cells: Cells) -> Float32[ndarray, "h w"]:
    """Roughly where in its cell each pixel lies, in cells; NaN unless all of its bits are certain or at a border.

    In the middle of a cell both bits that change at its borders are certain. Near a border that border's bit is
    not, and a pixel may have been given either of the two cells: both give a place near the border.
    """
    before, after = _border_bit(cells, cells.cell - 1), _border_bit(cells, cells.cell)
    before = np.where(cells.cell == 0, np.maximum(after, 1), before)  # the first cell has no border before it
    place = cells.cell + 0.5 + 0.5 * (before - after) / np.maximum(before + after, 1)
    return np.where(cells.level == 0, place, np.nan).astype(np.float32)


def phase_coordinates(
    photographs: Photographs, axis: int, coarse: Float32[ndarray, "h w"] | None, noise: float
) -> Float32[ndarray, "h w"]:
    """Coordinate of every pixel in pattern pixels from all sines of an axis, the longest first; NaN where unknown.

    `coarse` is the coordinate from the Gray code; None if the sequence has none, and then the longest sine has no
    more than one period. `noise` is the standard deviation of an image.
    """
    found = coarse
    for steps, period in photographs.layout.sines(axis):
        sine = photographs.sine(axis, steps, period)
        place = sine.phase * np.float32(period / (2 * np.pi)) + np.float32(_PIXEL_CENTRE)
        number = 0 if found is None else np.rint((found - place) / np.float32(period))
        found = place + np.float32(period) * number
        found = np.where(sine.amplitude > _LEAST_AMPLITUDE * noise * np.sqrt(2 / steps), found, np.float32(np.nan))
    if found is None:
        raise ValueError(f"axis {axis} has neither bits nor sines")
    return found.astype(np.float32)


def _border_bit(cells: Cells, first: Int32[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
    """How certain the bit is that changes between cell `first` and the next one; the largest value past the last."""
    bits = len(cells.difference)
    flipped = gray(np.maximum(first, 0)) ^ gray(np.maximum(first, 0) + 1)
    bit = np.rint(np.log2(flipped)).astype(np.int64)
    index = np.clip(bits - 1 - bit, 0, bits - 1)[None]
    value = np.abs(np.take_along_axis(cells.difference, index, 0)[0].astype(np.float32))
    return np.where(bit < bits, value, np.float32(np.iinfo(np.int16).max))
