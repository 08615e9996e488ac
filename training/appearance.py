"""Random light and texture: from a surface and its pattern to the light that reaches the camera."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from training.patterns import DrawnPattern
from training.surfaces import Surface
from training.textures import log_uniform, natural, printed, smooth_field


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
    lines = pattern.defocused(surface.coords, surface.defocus)
    leak = np.float32(rng.uniform(0, 0.08))
    projected = (leak + (1 - leak) * lines) * surface.lit * surface.shading
    n = len(lines)
    ambient = rng.uniform(0, 0.6 * hard.light) * (1 + 0.4 * smooth_field(rng, n, 2))
    ambient = np.clip(ambient, 0, None) + rng.uniform(0, 0.1)
    glow = rng.uniform(0, 0.5 * hard.light) * cv2.GaussianBlur(_small(projected), (0, 0), rng.uniform(2, 8))
    light = projected + ambient + cv2.resize(glow, (n, n), interpolation=cv2.INTER_LINEAR)
    if rng.random() < 0.4 * hard.light:
        light = light + _reflected(rng, surface, pattern)
    light = light * _albedo(rng, surface, hard.texture)
    if rng.random() < 0.4 * hard.light:
        light = light + _gloss(rng, projected, ambient)
    return np.where(surface.layer >= 0, light, _background(rng, n, surface.pixels_a_period, hard)).astype(np.float32)


def _small(image: Float32[ndarray, "n n"]) -> Float32[ndarray, "m m"]:
    return cv2.resize(image, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)


def _reflected(rng: np.random.Generator, surface: Surface, pattern: DrawnPattern) -> Float32[ndarray, "n n"]:
    """A second, blurred copy of the pattern from elsewhere, as one surface throws it onto another."""
    n, cells = len(surface.layer), np.array(pattern.codes.shape, dtype=np.float32)
    coords = cells - surface.coords if rng.random() < 0.5 else surface.coords[:, ::-1]
    coords = coords * np.float32(log_uniform(rng, 0.5, 1.5)) + rng.uniform(-8, 8, 2).astype(np.float32)
    blur = np.full((n, n), rng.uniform(0.08, 0.2), dtype=np.float32)
    near = np.clip(0.5 + smooth_field(rng, n, int(rng.integers(1, 4))), 0, 1)
    return rng.uniform(0.05, 0.25) * near * pattern.defocused(np.ascontiguousarray(coords), blur)


def _gloss(
    rng: np.random.Generator, projected: Float32[ndarray, "n n"], ambient: Float32[ndarray, "n n"]
) -> Float32[ndarray, "n n"]:
    """Highlights with soft borders: of the projector, in which the pattern remains until it saturates, or of a lamp."""
    n = len(projected)
    spots = np.clip(smooth_field(rng, n, int(rng.integers(3, 16))) - rng.uniform(0.8, 1.8), 0, None)
    mirrored = projected if rng.random() < 0.6 else ambient + 0.3
    return log_uniform(rng, 0.5, 12.0) * spots * mirrored


def _albedo(rng: np.random.Generator, surface: Surface, hard: float) -> Float32[ndarray, "n n"]:
    """Blotches, fine grain, prints and patches, different on each layer."""
    n = len(surface.layer)
    albedo = np.exp(rng.uniform(0.05, 0.1 + 0.35 * hard) * smooth_field(rng, n, int(rng.integers(2, 10))))
    if rng.random() < 0.3 + 0.4 * hard:
        albedo *= np.exp(rng.uniform(0, 0.25 * hard) * smooth_field(rng, n, int(rng.integers(12, 60))))
    if rng.random() < 0.5 * hard:
        patches = smooth_field(rng, n, int(rng.integers(3, 12))) > rng.uniform(-0.5, 1.0)
        albedo *= np.where(patches, rng.uniform(0.1, 1.0), 1.0)
    for layer in range(int(surface.layer.max(initial=0)) + 1):
        if rng.random() < 0.6 * hard:
            make = printed(rng, n, surface.pixels_a_period) if rng.random() < 0.6 else natural(rng, n)
            albedo = np.where(surface.layer == layer, albedo * make, albedo)
    shades = rng.uniform(0.6, 1.0, 6) * np.where(rng.random(6) < 0.3 * hard, rng.uniform(0.15, 0.6, 6), 1.0)
    return (0.8 * albedo * shades[surface.layer]).astype(np.float32)


def _background(
    rng: np.random.Generator, n: int, pixels_a_period: float, hard: Difficulty
) -> Float32[ndarray, "n n"] | float:
    """What lies behind the object, out of the projector's light: dark, bright, or with a texture of its own."""
    if rng.random() < 0.5:
        return rng.uniform(0.0, 0.06) if rng.random() < 0.7 else rng.uniform(0.0, 0.4) * hard.light
    brightness = log_uniform(rng, 0.03, 0.9)
    texture = printed(rng, n, pixels_a_period) if rng.random() < 0.6 else natural(rng, n)
    if rng.random() < 0.2:
        texture = texture * printed(rng, n, pixels_a_period)
    return brightness * texture * (1 + 0.2 * smooth_field(rng, n, 2))
