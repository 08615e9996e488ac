"""Random light, texture, lens and sensor: from a surface and its pattern to the image of a camera."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from training.noise_fields import log_uniform, smooth_field
from training.patterns import DrawnPattern
from training.surfaces import Surface


@dataclass(frozen=True)
class Difficulty:
    """How strong each kind of disturbance is: 1 is as bad as a capture may get, 0 is a clean one."""

    texture: float
    light: float
    blur: float
    noise: float


def random_difficulty(rng: np.random.Generator) -> Difficulty:
    """Independent for each kind of disturbance; weak ones are more frequent."""
    return Difficulty(*(float(value) for value in rng.random(4) ** 1.7))


def illuminate(
    rng: np.random.Generator, surface: Surface, pattern: DrawnPattern, hard: Difficulty
) -> Float32[ndarray, "n n"]:
    """Light that leaves the surface; 1 is a white surface in the full light of the projector."""
    place = ((surface.coords + 0.5) * pattern.period - 0.5).astype(np.float32)
    lines = cv2.remap(pattern.picture, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    leak = np.float32(rng.uniform(0, 0.08))
    projected = (leak + (1 - leak) * lines) * surface.lit * surface.shading
    n = len(lines)
    ambient = rng.uniform(0, 0.6 * hard.light) * (1 + 0.4 * smooth_field(rng, n, 2))
    ambient = np.clip(ambient, 0, None) + rng.uniform(0, 0.1)
    glow = rng.uniform(0, 0.5 * hard.light) * cv2.GaussianBlur(_small(projected), (0, 0), rng.uniform(2, 8))
    glow = cv2.resize(glow, (n, n), interpolation=cv2.INTER_LINEAR)
    light = (projected + ambient + glow) * _albedo(rng, surface, hard.texture)
    background = rng.uniform(0.0, 0.06) if rng.random() < 0.7 else rng.uniform(0.0, 0.4) * hard.light
    return np.where(surface.layer >= 0, light, background).astype(np.float32)


def _small(image: Float32[ndarray, "n n"]) -> Float32[ndarray, "m m"]:
    return cv2.resize(image, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)


def _albedo(rng: np.random.Generator, surface: Surface, hard: float) -> Float32[ndarray, "n n"]:
    """Blotches, fine grain, stripes and printed patches, different on each layer."""
    n = len(surface.layer)
    albedo = np.exp(rng.uniform(0.05, 0.1 + 0.35 * hard) * smooth_field(rng, n, int(rng.integers(2, 10))))
    if rng.random() < 0.3 + 0.4 * hard:
        albedo *= np.exp(rng.uniform(0, 0.25 * hard) * smooth_field(rng, n, int(rng.integers(12, 60))))
    if rng.random() < 0.5 * hard:
        patches = smooth_field(rng, n, int(rng.integers(3, 12))) > rng.uniform(-0.5, 1.0)
        albedo *= np.where(patches, rng.uniform(0.3, 1.0), 1.0)
    if rng.random() < 0.3 * hard:
        row, column = np.mgrid[:n, :n].astype(np.float32)
        angle, length = rng.uniform(0, np.pi), n * log_uniform(rng, 0.03, 0.5)
        wave = np.sin((np.cos(angle) * row + np.sin(angle) * column) * np.float32(2 * np.pi / length))
        albedo *= 1 - rng.uniform(0, 0.6) * (wave > rng.uniform(-0.7, 0.9))
    shades = rng.uniform(0.6, 1.0, 6)
    return (0.8 * albedo * shades[surface.layer]).astype(np.float32)


def photograph(
    rng: np.random.Generator, light: Float32[ndarray, "n n"], size: int, sampling: int, hard: Difficulty
) -> Float32[ndarray, "s s"]:
    """Lens, exposure, noise and rounding; the camera's pixels may be larger or smaller than those of the result.

    The decoder scales a capture until its grid has a fixed period, so noise and sharpness depend on the resolution of
    the camera: `native` is the size of a pixel of the result in pixels of the camera.
    """
    native = log_uniform(rng, 0.55, 2.0)
    own = max(8, round(size * min(native, 1.0)))  # finer cameras are averaged, which only reduces their noise
    blurred = _lens(rng, light, sampling, hard.blur)
    image = cv2.resize(blurred, (own, own), interpolation=cv2.INTER_AREA)
    exposure = log_uniform(rng, 0.25, 1.5) if rng.random() < 0.8 else log_uniform(rng, 1.5, 3.5)
    signal = image * np.float32(exposure)
    signal = _speckle(rng, signal, hard.noise)
    sigma = rng.uniform(0.002, 0.015 + 0.06 * hard.noise) / max(native, 1.0)
    signal = signal + sigma * np.sqrt(0.15 + 0.85 * signal) * rng.standard_normal(signal.shape, dtype=np.float32)
    if rng.random() < 0.15:
        signal = np.maximum(signal, 0) ** rng.uniform(0.6, 1.5)
    rounded = np.rint(255 * np.clip(signal, 0, 1)).astype(np.float32) / 255
    return rounded if own == size else cv2.resize(rounded, (size, size), interpolation=cv2.INTER_CUBIC)


def _lens(
    rng: np.random.Generator, light: Float32[ndarray, "n n"], sampling: int, hard: float
) -> Float32[ndarray, "n n"]:
    """Defocus, or the camera's motion."""
    sigma = sampling * rng.uniform(0.2, 0.8 + 1.8 * hard)
    blurred = cv2.GaussianBlur(light, (0, 0), sigma)
    if rng.random() < 0.25 * hard:
        length = max(3, round(sampling * rng.uniform(2, 5)))
        kernel = np.zeros((length, length), dtype=np.float32)
        cv2.line(kernel, (0, int(rng.integers(length))), (length - 1, int(rng.integers(length))), (1.0,))
        kernel = kernel.T if rng.random() < 0.5 else kernel
        blurred = cv2.filter2D(blurred, -1, kernel / kernel.sum())
    return blurred


def _speckle(rng: np.random.Generator, signal: Float32[ndarray, "n n"], hard: float) -> Float32[ndarray, "n n"]:
    """Laser speckle: multiplies the light, in spots of about a pixel."""
    if rng.random() > 0.3 + 0.5 * hard:
        return signal
    grain = rng.standard_normal(signal.shape, dtype=np.float32)
    spot = rng.uniform(0.3, 1.0)
    grain = cv2.GaussianBlur(grain, (0, 0), spot)
    contrast = rng.uniform(0, 0.1 + 0.25 * hard)
    return signal * np.maximum(1 + contrast * grain / grain.std(), 0)
