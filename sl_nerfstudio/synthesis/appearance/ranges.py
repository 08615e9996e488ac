"""How strongly captures differ from ideal ones: the ranges of `--appearance realistic` and `hard`."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

AppearanceKind = Literal["plain", "realistic", "hard"]
Range = tuple[float, float]


@dataclass(frozen=True)
class Ranges:
    """Each property is drawn between two values, once for a scan or once for each frame.

    Blur of the camera is in pixels of an image 600 pixels wide, and grows with its width.
    """

    # of a scan
    pattern_blur: Range  # sigma of the projected pattern in focus, pattern pixels
    pattern_defocus: Range  # sigma added in quadrature half the object's size off the focal plane, pattern pixels
    camera_blur: Range  # sigma in focus, pixels
    camera_defocus: Range  # sigma added in quadrature half the object's size off the focal plane, pixels
    brightness: Range  # of the object's material, share of light reflected
    texture_contrast: Range  # share of light that a layer of texture takes away at most
    texture_layers: tuple[int, int]  # number on the object, least and most
    gloss: Range  # strength of the highlight
    gloss_exponent: Range
    room_light: Range  # all of it, for a white surface, where the lamp of the projector has 1
    gamma: Range
    noise: Range  # times --sensor-noise
    useless: float  # share of the frames
    # of a frame
    exposure: Range  # times the one that suits the material
    motion: Range  # length of the path of a point in the image while the shutter is open, pixels
    jpeg_quality: Range
    shake: Range  # the same as `motion`, in frames spoiled by it


REALISTIC = Ranges(
    pattern_blur=(0.5, 0.9),
    pattern_defocus=(1.0, 2.2),
    camera_blur=(0.5, 0.9),
    camera_defocus=(0.3, 1.1),
    brightness=(0.45, 0.85),
    texture_contrast=(0.2, 0.55),
    texture_layers=(1, 2),
    gloss=(0.02, 0.2),
    gloss_exponent=(8.0, 60.0),
    room_light=(0.06, 0.28),
    gamma=(1.8, 2.4),
    noise=(0.8, 1.8),
    useless=0.04,
    exposure=(0.7, 1.4),
    motion=(0.0, 2.2),
    jpeg_quality=(78.0, 95.0),
    shake=(14.0, 30.0),
)

HARD = Ranges(
    pattern_blur=(0.6, 1.1),
    pattern_defocus=(1.3, 2.3),
    camera_blur=(0.5, 1.0),
    camera_defocus=(0.6, 1.5),
    brightness=(0.3, 0.85),
    texture_contrast=(0.3, 0.65),
    texture_layers=(1, 3),
    gloss=(0.08, 0.35),
    gloss_exponent=(8.0, 90.0),
    room_light=(0.12, 0.45),
    gamma=(1.6, 2.6),
    noise=(1.3, 3.0),
    useless=0.1,
    exposure=(0.55, 1.7),
    motion=(0.0, 3.5),
    jpeg_quality=(60.0, 88.0),
    shake=(12.0, 30.0),
)

RANGES: dict[AppearanceKind, Ranges] = {"realistic": REALISTIC, "hard": HARD}


def draw(rng: np.random.Generator, bounds: Range) -> float:
    """A value between both bounds, uniformly."""
    return float(rng.uniform(*bounds))


def draw_log(rng: np.random.Generator, bounds: Range) -> float:
    """A value between both bounds, uniformly in its logarithm."""
    return float(np.exp(rng.uniform(*np.log(bounds))))
