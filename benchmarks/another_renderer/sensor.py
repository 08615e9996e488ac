"""From light to a file: blur of lens and motion, exposure, noise, gamma, JPEG."""

import io
from dataclasses import dataclass

import cv2
import numpy as np
from numpy import ndarray
from PIL import Image


@dataclass(frozen=True)
class Sensor:
    """How good the camera is."""

    blur_px: float = 0.5  # sigma in focus, pixels
    defocus_px: float = 0.0  # sigma at one and a half times the distance in focus
    motion_px: float = 0.0  # longest smear
    electrons: float = 12000.0  # at full scale
    read_noise: float = 0.002  # of full scale
    exposure_stops: float = 0.0  # frames differ by up to this, either way
    gamma: float = 2.2
    quality: int = 95  # of JPEG
    vignetting: float = 0.0  # light lost in the corners, share
    denoising_px: float = 0.0  # sigma of a filter that keeps edges
    sharpening: float = 0.0  # share of what a blur of 1.2 pixels takes away that is added
    tone: float = 0.0  # how far the tones are drawn to an S, as in the pictures of telephones; at most 1
    thinned_colour: bool = False  # colour at half the resolution in JPEG


def blurred_by_depth(light: ndarray, depth: ndarray, focus: float, sensor: Sensor) -> ndarray:
    """(h, w, 3), each pixel blurred by its own distance."""
    sigma = np.full(depth.shape, sensor.blur_px)
    far = np.where(np.isfinite(depth), depth, 3 * focus)
    sigma += 3 * sensor.defocus_px * np.abs(1 - focus / far)
    levels = np.linspace(float(sigma.min()), float(max(np.quantile(sigma, 0.995), sigma.min() + 1e-3)), 4)
    place = np.clip((sigma - levels[0]) / (levels[1] - levels[0]), 0, 3)
    result = np.zeros_like(light)
    for k, level in enumerate(levels):
        weight = np.maximum(1 - np.abs(place - k), 0)[..., None]
        result += weight * cv2.GaussianBlur(light, (0, 0), float(max(level, 0.05)))
    return result


def smeared(light: ndarray, length: float, angle: float) -> ndarray:
    """Moved along a line of `length` pixels during the exposure."""
    if length < 0.2:
        return light
    result, steps = np.zeros_like(light), 7
    for t in np.linspace(-0.5, 0.5, steps) * length:
        M = np.array([[1, 0, t * np.cos(angle)], [0, 1, t * np.sin(angle)]])
        result += cv2.warpAffine(light, M, light.shape[1::-1], flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return result / steps


def exposed(light: ndarray, depth: ndarray, focus: float, sensor: Sensor, rng: np.random.Generator) -> ndarray:
    """Values from 0 to 255 of light (h, w, 3): the brightest hundredth comes near full scale, but for the exposure."""
    image = blurred_by_depth(light.astype(np.float32), depth, focus, sensor)
    image = smeared(image, sensor.motion_px * rng.uniform(0, 1), rng.uniform(0, np.pi))
    stops = sensor.exposure_stops * rng.uniform(-1, 1) - 0.15
    image = image / max(float(np.quantile(image, 0.99)), 1e-6) * 2**stops
    image = image * _vignette(image.shape, sensor.vignetting)
    electrons = rng.normal(image, np.sqrt(np.maximum(image, 0) / sensor.electrons + sensor.read_noise**2))
    return (255 * processed(np.clip(electrons, 0, 1) ** (1 / sensor.gamma), sensor) + 0.5).astype(np.uint8)


def processed(values: ndarray, sensor: Sensor) -> ndarray:
    """Values from 0 to 1 (h, w, 3) as the camera's own software leaves them."""
    if sensor.denoising_px:
        values = cv2.bilateralFilter(values.astype(np.float32), -1, 0.05, sensor.denoising_px)
    if sensor.sharpening:
        values = values + sensor.sharpening * (values - cv2.GaussianBlur(values, (0, 0), 1.2))
    values = np.clip(values, 0, 1)
    return values + sensor.tone * (values**2 * (3 - 2 * values) - values)


def _vignette(shape: tuple[int, ...], share: float) -> ndarray:
    """(h, w, 1) of an image of `shape`, 1 in its middle."""
    y, x = (np.linspace(-1, 1, n) for n in shape[:2])
    return (1 - share * ((x[None, :] ** 2 + y[:, None] ** 2) / 2))[..., None]


def jpeg(values: ndarray, sensor: Sensor, colour: bool) -> bytes:
    """An image file of (h, w, 3), grey unless `colour`."""
    image = Image.fromarray(values if colour else values[..., 1])
    stored = io.BytesIO()
    image.save(stored, "JPEG", quality=sensor.quality, subsampling=2 if sensor.thinned_colour else 0)
    return stored.getvalue()
