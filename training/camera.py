"""Random lens, sensor and file of a camera: from the light that arrives to the image that the decoder is given."""

import cv2
import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from training.textures import log_uniform, smooth_field


def photograph(
    rng: np.random.Generator, light: Float32[ndarray, "n n"], size: int, sampling: int, blur: float, noise: float
) -> Float32[ndarray, "s s"]:
    """Lens, exposure, noise, tone curve, compression and rounding; `blur` and `noise` are from 0 to 1.

    The decoder scales a capture until its grid has a fixed period, so noise, sharpness and the blocks of a compressed
    file depend on the resolution of the camera: `native` is the size of a pixel of the result in pixels of the camera.
    """
    native = log_uniform(rng, 0.55, 2.0)
    own = max(8, round(size * native))
    image = cv2.resize(_lens(rng, light, sampling, blur), (own, own), interpolation=cv2.INTER_AREA)
    exposure = log_uniform(rng, 0.15, 1.5) if rng.random() < 0.8 else log_uniform(rng, 1.5, 3.5)
    signal = _speckle(rng, image * np.float32(exposure), noise)
    sigma = rng.uniform(0.002, 0.015 + 0.06 * noise)
    signal = signal + sigma * np.sqrt(0.15 + 0.85 * signal) * rng.standard_normal(signal.shape, dtype=np.float32)
    signal = np.clip(signal, 0, 1)
    if rng.random() < 0.5:
        signal **= np.float32(rng.uniform(0.4, 1.3))
    stored = _compressed(rng, np.rint(255 * signal).astype(np.uint8)).astype(np.float32) / 255
    if own == size:
        return stored
    return cv2.resize(stored, (size, size), interpolation=cv2.INTER_AREA if own > size else cv2.INTER_CUBIC)


def _lens(
    rng: np.random.Generator, light: Float32[ndarray, "n n"], sampling: int, hard: float
) -> Float32[ndarray, "n n"]:
    """Defocus, which may differ from one side to the other, and the camera's motion."""
    sigma = sampling * rng.uniform(0.2, 0.8 + 1.8 * hard)
    blurred = cv2.GaussianBlur(light, (0, 0), sigma)
    if rng.random() < 0.3:
        other = cv2.GaussianBlur(light, (0, 0), sampling * rng.uniform(0.2, 0.8 + 1.8 * hard))
        share = np.clip(0.5 + smooth_field(rng, len(light), 1), 0, 1)
        blurred = blurred + share * (other - blurred)
    if rng.random() < 0.1 + 0.3 * hard:
        blurred = cv2.filter2D(blurred, -1, _path(rng, sampling * rng.uniform(1, 3)))
    return blurred


def _path(rng: np.random.Generator, half: float) -> Float32[ndarray, "k k"]:
    """A straight path of the camera, symmetric about the middle: the truth lies where the image is on average."""
    middle, angle = max(1, int(np.ceil(half))), rng.uniform(0, np.pi)
    kernel = np.zeros((2 * middle + 1, 2 * middle + 1), dtype=np.float32)
    dx, dy = round(half * np.cos(angle)), round(half * np.sin(angle))
    cv2.line(kernel, (middle - dx, middle - dy), (middle + dx, middle + dy), (1.0,))
    kernel = kernel + kernel[::-1, ::-1]
    return kernel / kernel.sum()


def _speckle(rng: np.random.Generator, signal: Float32[ndarray, "n n"], hard: float) -> Float32[ndarray, "n n"]:
    """Laser speckle: multiplies the light, in spots of about a pixel."""
    if rng.random() > 0.2 + 0.4 * hard:
        return signal
    grain = rng.standard_normal(signal.shape, dtype=np.float32)
    grain = cv2.GaussianBlur(grain, (0, 0), rng.uniform(0.3, 1.0))
    contrast = rng.uniform(0, 0.1 + 0.25 * hard)
    return signal * np.maximum(1 + contrast * grain / grain.std(), 0)


def _compressed(rng: np.random.Generator, image: ndarray) -> ndarray:
    """The image as a JPEG file stores it, in half of the captures."""
    if rng.random() < 0.5:
        return image
    _, file = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(45, 96))])
    return cv2.imdecode(file, cv2.IMREAD_GRAYSCALE)
