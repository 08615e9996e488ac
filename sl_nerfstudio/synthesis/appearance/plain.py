"""Optical properties of the object, the room, the projector's lamp and the lens."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray
from scipy.ndimage import gaussian_filter

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.synthesis.scenes.scene import Scene

_WAVES = 14


@dataclass(frozen=True)
class Appearance:
    """A matte surface with faint blotches, weak room light, a lamp that fades towards the corners, a slight blur."""

    reference_distance: float  # millimetres: where the lamp has unit strength
    wave_vectors: Float[ndarray, "k 3"]
    wave_phases: Float[ndarray, "k"]
    mean_albedo: float = 0.78
    albedo_contrast: float = 0.16
    room_light: float = 0.08
    background: float = 0.025
    dark_leak: float = 0.04  # light of the projector where the pattern is dark
    corner_loss: float = 0.35  # of the lamp, in the pattern's corners
    blur: float = 0.55  # sigma of the lens, pixels

    def albedo(self, p_world: Float[ndarray, "n 3"]) -> Float32[ndarray, "n"]:
        """Share of light reflected: smooth random blotches from some millimetres to the size of the object."""
        angle = p_world.astype(np.float32) @ self.wave_vectors.T.astype(np.float32)
        texture = np.cos(angle + self.wave_phases.astype(np.float32)).sum(-1) * np.sqrt(2 / _WAVES)
        return np.clip(self.mean_albedo * (1 + self.albedo_contrast * texture), 0.25, 1.0).astype(np.float32)

    def ambient(self, normal: Float32[ndarray, "n 3"]) -> Float32[ndarray, "n"]:
        """Light from the room, stronger from above."""
        return np.float32(self.room_light) * (np.float32(0.75) + np.float32(0.25) * normal[:, 2])

    def projected(self, intensity: Float32[ndarray, "n"]) -> Float32[ndarray, "n"]:
        """Light of the projector for a pattern value in [0, 1]."""
        return np.float32(self.dark_leak) + np.float32(1 - self.dark_leak) * intensity

    def projector_fall_off(self, uv: Float[ndarray, "n 2"], projector: Device) -> Float[ndarray, "n"]:
        """Strength of the lamp across the pattern: 1 in the middle."""
        middle, half = np.array([projector.w, projector.h]) / 2, np.hypot(projector.w, projector.h) / 2
        return 1 - self.corner_loss * ((uv - middle) ** 2).sum(-1) / half**2

    def through_lens(self, image: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
        """The image as blurred by the lens."""
        return gaussian_filter(image, self.blur, truncate=4.0).astype(np.float32)


def make_appearance(scene: Scene, distance: float, rng: np.random.Generator) -> Appearance:
    """A random texture in proportion to the object."""
    wavelength = scene.size * np.exp(rng.uniform(np.log(0.08), np.log(0.9), _WAVES))
    direction = rng.normal(size=(_WAVES, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return Appearance(
        reference_distance=distance,
        wave_vectors=direction * (2 * np.pi / wavelength)[:, None],
        wave_phases=rng.uniform(0, 2 * np.pi, _WAVES),
    )
