"""Exposure of an image, where it matters: where the pattern is."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray
from scipy.ndimage import maximum_filter

_SATURATED = 0.995  # of full scale
_DARK = 0.06  # of full scale: lines as dark as this are lost in the noise of most cameras


@dataclass(frozen=True)
class Light:
    """Shares of the places that show the pattern; of the whole image where none does."""

    saturated: float  # a pixel at full scale
    dark: float  # nothing brighter than a few hundredths of full scale, not even the lines


def measure_light(
    grey: Float32[ndarray, "h w"], at: Float32[ndarray, "n 2"] | None = None, period: float = 8.0
) -> Light:
    """The light at pixels (x, y), in windows of a period of the pattern around them; without them, everywhere."""
    side = max(3, round(period))
    brightest = maximum_filter(grey, side)
    if at is None:
        return Light(float((grey >= _SATURATED).mean()), float((brightest < _DARK).mean()))
    h, w = grey.shape
    x, y = np.clip(at.astype(np.int64), 0, (w - 1, h - 1)).T
    inside = _windows(grey.shape, x, y, side)
    return Light(float((grey[inside] >= _SATURATED).mean()), float((brightest[y, x] < _DARK).mean()))


def _windows(shape: tuple[int, ...], x: ndarray, y: ndarray, side: int) -> Bool[ndarray, "h w"]:
    """Pixels within half a window of one of the places."""
    marked = np.zeros(shape, dtype=np.uint8)
    marked[y, x] = 1
    return maximum_filter(marked, side) > 0
