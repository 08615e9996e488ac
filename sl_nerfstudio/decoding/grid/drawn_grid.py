"""The pattern as it should appear in an image: drawn at several degrees of sharpness, under uneven light."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32
from numpy import ndarray

_BLURS = (0.045, 0.1, 0.18)  # periods


@dataclass(frozen=True)
class DrawnGrid:
    """The pattern at one sharpness: values and derivatives by x and y, per period."""

    layers: Float32[ndarray, "h w 3"]
    period: float

    def at(self, coords: Float32[ndarray, "h w 2"]) -> Float32[ndarray, "h w 3"]:
        """Bilinear values at pattern pixels."""
        place = np.nan_to_num(coords) - np.float32(0.5)
        return cv2.remap(self.layers, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def draw_sharpnesses(picture: Float32[ndarray, "h w"], period: float) -> tuple[DrawnGrid, ...]:
    """The pattern as it appears through lenses of different sharpness."""
    drawn = []
    for blur in _BLURS:
        soft = cv2.GaussianBlur(picture, (0, 0), blur * period)
        gy, gx = np.gradient(soft)
        drawn.append(DrawnGrid(np.stack([soft, gx * period, gy * period], -1).astype(np.float32), period))
    return tuple(drawn)


@dataclass(frozen=True)
class Light:
    """How much light a pattern value of one adds at a pixel, and how much is there without the pattern.

    On a surface that gets darker to one side, a line compared with an evenly lit one would seem shifted to the other
    side.
    """

    contrast: Float32[ndarray, "h w"]
    brightness: Float32[ndarray, "h w"]

    @staticmethod
    def even(shape: tuple[int, ...]) -> "Light":
        """Contrast one everywhere, and no light without the pattern."""
        return Light(np.ones(shape, dtype=np.float32), np.zeros(shape, dtype=np.float32))

    def on(self, drawn: Float32[ndarray, "h w 3"]) -> Float32[ndarray, "h w 3"]:
        """The drawn pattern and its derivatives as they should appear in the image."""
        lit = drawn * self.contrast[..., None]
        lit[..., 0] += self.brightness
        return lit
