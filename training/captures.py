"""Random captures with their truth, for training the U-Net; about twenty per second."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int8
from numpy import ndarray

from sl_nerfstudio.decoding.grid_phases import network_channels
from training.appearance import illuminate, random_difficulty
from training.camera import photograph
from training.patterns import CELLS, PatternStock
from training.surfaces import Surface, random_surface
from training.textures import log_uniform

_SAMPLING = 2


@dataclass(frozen=True)
class Capture:
    """An image of s x s pixels, and the truth at every second place (where four pixels meet)."""

    channels: Float32[ndarray, "2 s s"]
    lit: Bool[ndarray, "h h"]
    certain: Bool[ndarray, "h h"]  # all four pixels show the same surface
    coords: Float32[ndarray, "h h 2"]  # periods
    symbol: Int8[ndarray, "h h"]  # of the nearest node


def random_capture(rng: np.random.Generator, stock: PatternStock, size: int) -> Capture:
    """One random surface under one random pattern in random light."""
    surface, pattern, hard = random_surface(rng, size, _SAMPLING, CELLS), stock.pick(), random_difficulty(rng)
    light = illuminate(rng, surface, pattern, hard)
    view = photograph(rng, light, size, _SAMPLING, hard.blur, hard.noise)
    bright = float(np.quantile(view, 0.995)) * log_uniform(rng, 0.9, 4.0)  # other parts of the image may be brighter
    coords, lit, certain = _at_corners(surface)
    node = np.clip(np.rint(coords), 0, CELLS - 1).astype(np.int64)
    return Capture(network_channels(view, bright), lit, certain, coords, pattern.codes[node[..., 1], node[..., 0]])


def _at_corners(
    surface: Surface,
) -> tuple[Float32[ndarray, "h h 2"], Bool[ndarray, "h h"], Bool[ndarray, "h h"]]:
    """Coordinates and light where four pixels meet: the mean of the four places around."""
    stride, first = 2 * _SAMPLING, _SAMPLING - 1
    parts = [(first + a, first + b) for a in (0, 1) for b in (0, 1)]
    coords = sum(surface.coords[a::stride, b::stride] for a, b in parts) / np.float32(4)
    lit = np.stack([surface.lit[a::stride, b::stride] for a, b in parts])
    layer = np.stack([surface.layer[a::stride, b::stride] for a, b in parts])
    certain = (layer == layer[0]).all(0) & (lit == lit[0]).all(0)
    return np.asarray(coords), lit.mean(0) > 0.5, certain
