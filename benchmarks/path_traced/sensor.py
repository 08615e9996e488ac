"""From light to the file of a camera: exposure, photon noise, what a phone does to its pictures, tone, JPEG."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

_HIGHLIGHTS = 0.98  # quantile of the exposed pixels that is put just below white
_WHITE = 0.85


@dataclass(frozen=True)
class Sensor:
    """A sensor and its processing."""

    electrons: float  # at full scale
    read_noise: float  # share of full scale
    grey: bool = False
    linear: bool = False  # file values proportional to light; else sRGB
    denoising: float = 0.0  # standard deviation of a Gaussian, pixels
    sharpening: float = 0.0  # share of what a Gaussian of 1.2 pixels removes that is added
    stops: float = 0.3  # by which exposures are off at most
    quality: int = 92  # of JPEG


def developed(
    light: Float32[ndarray, "h w 3"], sensor: Sensor, rng: np.random.Generator
) -> tuple[UInt8[ndarray, "h w *c"], bytes]:
    """The picture, as its JPEG file shows it, and that file."""
    grey = light.mean(-1)
    lit = grey > 0.2 * np.quantile(grey, 0.999)
    white = np.quantile(grey[lit], _HIGHLIGHTS) if lit.any() else 1.0
    exposed = light * (_WHITE / max(white, 1e-12)) * 2 ** rng.uniform(-sensor.stops, sensor.stops)
    if sensor.grey:
        exposed = exposed.mean(-1, keepdims=True)
    value = rng.poisson(np.clip(exposed, 0, 1.5) * sensor.electrons) / sensor.electrons
    value = (value + rng.normal(0, sensor.read_noise, value.shape)).astype(np.float32)
    if sensor.denoising:
        value = cv2.GaussianBlur(value, (0, 0), sensor.denoising).reshape(value.shape)
    if sensor.sharpening:
        value = value + sensor.sharpening * (value - cv2.GaussianBlur(value, (0, 0), 1.2).reshape(value.shape))
    value = np.clip(value, 0, 1)
    if not sensor.linear:
        value = np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)
    picture = np.rint(255 * value).astype(np.uint8)
    _, encoded = cv2.imencode(".jpg", picture[..., ::-1] if not sensor.grey else picture,
                              [cv2.IMWRITE_JPEG_QUALITY, sensor.quality])  # fmt: skip
    shown = cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED)
    return (shown if sensor.grey else np.ascontiguousarray(shown[..., ::-1])), encoded.tobytes()
