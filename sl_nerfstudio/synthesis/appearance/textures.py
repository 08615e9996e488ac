"""Solid textures: where a surface is darker, as a function of the point in space, so that all frames agree.

Each function draws one texture for an object of a given size and returns a map from points (relative to the object's
middle, in its unit) to values from 0 (untouched) to 1 (fully coloured).
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float32, Int32
from numpy import ndarray
from scipy.spatial.transform import Rotation

Texture = Callable[[Float32[ndarray, "n 3"]], Float32[ndarray, "n"]]
TextureMaker = Callable[[float, np.random.Generator], Texture]
_WAVES = 12


def blotches(size: float, rng: np.random.Generator) -> Texture:
    """Smooth stains of all sizes."""
    waves = _waves(size, (0.08, 0.9), rng)
    return lambda p: _smooth_step(0.5 + 0.45 * waves(p))


def specks(size: float, rng: np.random.Generator) -> Texture:
    """Small dark grains, as in stone or sprayed paint."""
    waves = _waves(size, (0.02, 0.06), rng)
    level = np.float32(rng.uniform(0.5, 1.1))
    return lambda p: _smooth_step((waves(p) - level) * 3)


def stripes(size: float, rng: np.random.Generator) -> Texture:
    """Printed bands with crisp edges."""
    across, width = _directions(rng)[0], np.float32(size * rng.uniform(0.06, 0.2))
    share, crisp = np.float32(rng.uniform(0.3, 0.6)), width / np.float32(0.004 * size)

    def value(p: Float32[ndarray, "n 3"]) -> Float32[ndarray, "n"]:
        phase = p @ across / width
        # distance from the middle of a band, in band widths
        return np.clip((share / 2 - np.abs(phase - np.round(phase))) * crisp + np.float32(0.5), 0, 1)

    return value


def checks(size: float, rng: np.random.Generator) -> Texture:
    """Squares of two colours, as on cloth."""
    axes, width = _directions(rng)[:2], np.float32(size * rng.uniform(0.08, 0.2))
    crisp = width / np.float32(0.004 * size)

    def value(p: Float32[ndarray, "n 3"]) -> Float32[ndarray, "n"]:
        a, b = (np.clip(_triangle(p @ axis / width) * crisp, -0.5, 0.5) for axis in axes)
        return np.float32(0.5) + 2 * a * b

    return value


def wood(size: float, rng: np.random.Generator) -> Texture:
    """Annual rings about an axis beside the object, wavy."""
    x, y, _ = _directions(rng)
    spacing = np.float32(size * rng.uniform(0.025, 0.07))
    offset = np.float32(size * rng.uniform(0.4, 1.2))
    bend, grain = _waves(size, (0.3, 1.0), rng), _waves(size, (0.015, 0.03), rng)

    def value(p: Float32[ndarray, "n 3"]) -> Float32[ndarray, "n"]:
        radius = np.hypot(p @ x + offset, p @ y) + np.float32(0.03 * size) * bend(p)
        ring = radius / spacing
        ring = ring - np.floor(ring)
        return np.clip(ring * ring * np.float32(0.85) + np.float32(0.12) * grain(p), 0, 1)

    return value


def marble(size: float, rng: np.random.Generator) -> Texture:
    """Thin dark veins."""
    across, width = _directions(rng)[0], np.float32(size * rng.uniform(0.15, 0.4))
    coarse, fine = _waves(size, (0.15, 0.6), rng), _waves(size, (0.04, 0.12), rng)

    def value(p: Float32[ndarray, "n 3"]) -> Float32[ndarray, "n"]:
        phase = p @ across / width + np.float32(0.5) * coarse(p) + np.float32(0.1) * fine(p)
        return (1 - np.abs(np.sin(np.float32(np.pi) * phase))) ** 4

    return value


def print_marks(size: float, rng: np.random.Generator) -> Texture:
    """Lines of marks like letters: each place of a row holds random strokes of 4 x 6 dots, or a blank."""
    u, v, _ = _directions(rng)
    dot = np.float32(size * rng.uniform(0.006, 0.014))
    dense, seed = rng.uniform(0.4, 0.6), int(rng.integers(2**20))

    def value(p: Float32[ndarray, "n 3"]) -> Float32[ndarray, "n"]:
        column, row = np.floor(p @ u / dot).astype(np.int32), np.floor(p @ v / dot).astype(np.int32)
        letter, line = column // 5, row // 10
        inside = (column % 5 < 4) & (row % 10 < 6)
        blank = _hash(letter // 2, line, seed) % 5 == 0  # gaps between words
        stroke = _hash(column, row, seed + 1) < 1000 * dense
        return (inside & ~blank & stroke).astype(np.float32)

    return value


TEXTURES: dict[str, TextureMaker] = {
    "blotches": blotches,
    "specks": specks,
    "stripes": stripes,
    "checks": checks,
    "wood": wood,
    "marble": marble,
    "print": print_marks,
}


def _waves(size: float, lengths: tuple[float, float], rng: np.random.Generator) -> Texture:
    """A smooth random function with mean 0 and standard deviation 1; wavelengths in sizes of the object."""
    shortest, longest = np.log(lengths)
    wavelength = size * np.exp(rng.uniform(shortest, longest, _WAVES))
    direction = rng.normal(size=(_WAVES, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    k = (direction * (2 * np.pi / wavelength)[:, None]).T.astype(np.float32)
    phase = rng.uniform(0, 2 * np.pi, _WAVES).astype(np.float32)
    return lambda p: np.cos(p @ k + phase).sum(-1) * np.float32(np.sqrt(2 / _WAVES))


def _directions(rng: np.random.Generator) -> Float32[ndarray, "3 3"]:
    """Three perpendicular directions."""
    return Rotation.random(random_state=rng).as_matrix().astype(np.float32)


def _smooth_step(x: Float32[ndarray, "n"]) -> Float32[ndarray, "n"]:
    t = np.clip(x, 0, 1)
    return t * t * (3 - 2 * t)


def _triangle(x: Float32[ndarray, "n"]) -> Float32[ndarray, "n"]:
    """A triangle wave of period 2 with slope 1, zero at every whole number."""
    return np.abs((x + np.float32(0.5)) % 2 - 1) - np.float32(0.5)


def _hash(i: Int32[ndarray, "n"], j: Int32[ndarray, "n"], seed: int) -> Int32[ndarray, "n"]:
    """A number from 0 to 999 for each pair, without visible order."""
    h = i.astype(np.uint32) * np.uint32(374761393) + j.astype(np.uint32) * np.uint32(668265263) + np.uint32(seed)
    h = (h ^ (h >> np.uint32(13))) * np.uint32(1274126177)
    return ((h ^ (h >> np.uint32(16))) % np.uint32(1000)).astype(np.int32)
