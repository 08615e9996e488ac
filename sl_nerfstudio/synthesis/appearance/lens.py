"""The camera's lens and the hand that holds it: defocus by depth, and motion blur."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray

from sl_nerfstudio.synthesis.appearance.ranges import Ranges, draw

_LEVELS = 5  # blurred images between which each pixel is interpolated
_REFERENCE_WIDTH = 600  # pixels, of the image that the ranges are given for


@dataclass(frozen=True)
class Lens:
    """Blur by depth; lengths in millimetres, sigmas in pixels."""

    in_focus: float
    out_of_focus: float  # added in quadrature at `reach` from the focal plane
    focus: float
    reach: float
    largest: float

    def sigma(self, depth: Float[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
        """Blur at a depth; NaN where nothing is, which is far away."""
        off = (self.focus / np.where(np.isfinite(depth), depth, 2 * self.focus) - 1) * self.focus / self.reach
        return np.minimum(np.hypot(self.in_focus, self.out_of_focus * off), self.largest).astype(np.float32)

    def blurred(self, image: Float32[ndarray, "h w 3"], depth: Float[ndarray, "h w"]) -> Float32[ndarray, "h w 3"]:
        """Each pixel from an image blurred as its depth demands: exact where the depth is the same all around."""
        sigma = self.sigma(depth)
        level = np.linspace(self.in_focus, max(float(sigma.max()), self.in_focus + 1e-3), _LEVELS)
        stack = [cv2.GaussianBlur(image, (0, 0), float(s)) for s in level]
        place = (sigma - level[0]) / (level[1] - level[0])
        out = np.zeros_like(image)
        for k, one in enumerate(stack):
            out += np.maximum(1 - np.abs(place - k), 0)[..., None].astype(np.float32) * one
        return out


def make_lens(distance: float, size: float, width: int, ranges: Ranges, rng: np.random.Generator) -> Lens:
    """The focal plane is anywhere within the object."""
    zoom = width / _REFERENCE_WIDTH
    defocus = draw(rng, ranges.camera_defocus) * zoom
    focus = distance + size * rng.uniform(-0.35, 0.35)
    return Lens(draw(rng, ranges.camera_blur) * zoom, defocus, focus, 0.5 * size, 3.5 * zoom)


def moved(image: Float32[ndarray, "h w 3"], length: float, direction: float) -> Float32[ndarray, "h w 3"]:
    """The mean of the image along a straight path of `length` pixels in a direction (radians)."""
    if length < 0.1:
        return image
    half = int(np.ceil(length / 2)) + 1
    steps = ((np.arange(8 * half) + 0.5) / (8 * half) - 0.5) * length
    kernel = np.zeros((2 * half + 1, 2 * half + 1))
    for x, y in zip(half + steps * np.cos(direction), half + steps * np.sin(direction), strict=True):
        i, j = int(y), int(x)
        fy, fx = y - i, x - j
        kernel[i : i + 2, j : j + 2] += np.outer([1 - fy, fy], [1 - fx, fx])
    return cv2.filter2D(image, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)
