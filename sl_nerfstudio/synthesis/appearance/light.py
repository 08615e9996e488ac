"""Where light comes from: the projector's lamp with its defocused pattern, and the room."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.synthesis.appearance.material import tint
from sl_nerfstudio.synthesis.appearance.ranges import Ranges, draw

_LEVELS = np.array([0.0, 0.5, 0.8, 1.15, 1.55, 2.0, 2.5, 3.2], dtype=np.float32)  # sigma, pattern pixels
_LAMP_SHARE = (0.3, 0.7)  # of the room's light that comes from one lamp


@dataclass(frozen=True)
class DefocusedPattern:
    """The pattern blurred more and more; between two levels, values are interpolated."""

    levels: Float32[ndarray, "k h w"]
    in_focus: float  # sigma, pattern pixels
    out_of_focus: float  # sigma added in quadrature at `reach` from the focal plane, pattern pixels
    focus: float  # distance of the focal plane, millimetres
    reach: float

    def sigma(self, distance: Float[ndarray, "n"]) -> Float32[ndarray, "n"]:
        """Blur at a distance; the blur circle of a thin lens grows with the difference of the inverse distances."""
        off = (self.focus / distance - 1) * self.focus / self.reach
        return np.minimum(np.hypot(self.in_focus, self.out_of_focus * off), _LEVELS[-1]).astype(np.float32)

    def sample(self, uv: Float[ndarray, "n 2"], distance: Float[ndarray, "n"]) -> Float32[ndarray, "n"]:
        """Pattern values in [0, 1] at pattern pixels, as thrown onto surfaces at distances from the projector."""
        sigma = self.sigma(distance)
        upper = np.clip(np.searchsorted(_LEVELS, sigma), 1, len(_LEVELS) - 1)
        # variances add up, so interpolate in them
        low, high = _LEVELS[upper - 1] ** 2, _LEVELS[upper] ** 2
        share = (sigma**2 - low) / (high - low)
        return (1 - share) * self._bilinear(upper - 1, uv) + share * self._bilinear(upper, uv)

    def _bilinear(self, level: ndarray, uv: Float[ndarray, "n 2"]) -> Float32[ndarray, "n"]:
        h, w = self.levels.shape[1:]
        x, y = np.clip(uv[:, 0] - 0.5, 0, w - 1.001), np.clip(uv[:, 1] - 0.5, 0, h - 1.001)
        column, row = x.astype(np.int64), y.astype(np.int64)
        fx, fy = (x - column).astype(np.float32), (y - row).astype(np.float32)
        flat, at = self.levels.reshape(-1), (level * h + row) * w + column
        above = flat[at] * (1 - fx) + flat[at + 1] * fx
        below = flat[at + w] * (1 - fx) + flat[at + w + 1] * fx
        return above * (1 - fy) + below * fy


@dataclass(frozen=True)
class Lamp:
    """The projector's lamp."""

    colour: Float32[ndarray, "3"]
    dark_leak: float  # light where the pattern is dark
    corner_loss: float
    reference_distance: float  # millimetres: where the light has unit strength

    def strength(
        self, uv: Float[ndarray, "n 2"], distance: Float[ndarray, "n"], projector: Device
    ) -> Float32[ndarray, "n"]:
        """Light on a surface that faces the lamp, by the inverse-square law and the fall-off to the corners."""
        middle, half = np.array([projector.w, projector.h]) / 2, np.hypot(projector.w, projector.h) / 2
        fall_off = 1 - self.corner_loss * ((uv - middle) ** 2).sum(-1) / half**2
        return (fall_off * (self.reference_distance / distance) ** 2).astype(np.float32)

    def through_pattern(self, value: Float32[ndarray, "n"]) -> Float32[ndarray, "n"]:
        """Share of the lamp's light for a pattern value."""
        return np.float32(self.dark_leak) + np.float32(1 - self.dark_leak) * value


@dataclass(frozen=True)
class Room:
    """Light from everywhere, more from above, and one far lamp that throws shadows."""

    ambient: Float32[ndarray, "3"]
    lamp: Float32[ndarray, "3"]
    towards_lamp: Float32[ndarray, "3"]
    nothing: Float32[ndarray, "3"]  # what is seen where no surface is

    def diffuse(self, normal: Float32[ndarray, "n 3"], lamp_seen: Float32[ndarray, "n"]) -> Float32[ndarray, "n 3"]:
        """Light on surfaces; `lamp_seen` is 0 in the lamp's shadow and 1 outside."""
        up = np.float32(0.75) + np.float32(0.25) * normal[:, 2]
        facing = np.maximum(normal @ self.towards_lamp, 0) * lamp_seen
        return up[:, None] * self.ambient + facing[:, None] * self.lamp


def make_pattern(
    pattern: Float32[ndarray, "h w"], distance: float, size: float, ranges: Ranges, rng: np.random.Generator
) -> DefocusedPattern:
    """The focal plane is anywhere within the object."""
    blurred = [
        pattern,
        *(cv2.GaussianBlur(pattern, (0, 0), float(s), borderType=cv2.BORDER_REPLICATE) for s in _LEVELS[1:]),
    ]
    return DefocusedPattern(
        np.stack(blurred).astype(np.float32),
        draw(rng, ranges.pattern_blur),
        draw(rng, ranges.pattern_defocus),
        distance + size * rng.uniform(-0.35, 0.35),
        0.5 * size,
    )


def make_lamp(distance: float, rng: np.random.Generator) -> Lamp:
    """White, warm, cold or tinted."""
    return Lamp(tint(rng.choice([0.08, 0.3]), rng), rng.uniform(0.02, 0.08), rng.uniform(0.2, 0.5), distance)


def make_room(ranges: Ranges, rng: np.random.Generator) -> Room:
    """Room light in one tint, and its lamp above."""
    level, share = draw(rng, ranges.room_light), rng.uniform(*_LAMP_SHARE)
    colour = tint(0.15, rng)
    azimuth, elevation = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(35, 80))
    flat = np.cos(elevation)
    towards = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], dtype=np.float32)
    nothing = colour * np.float32(level * rng.uniform(0.05, 0.3) + 0.01)
    return Room(colour * np.float32(level * (1 - share)), tint(0.15, rng) * np.float32(level * share), towards, nothing)
