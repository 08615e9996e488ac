"""Random captures that the decoder has read, with the truth: what the edge network is trained on."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from sl_nerfstudio.decoding.decoder import DecodingError
from sl_nerfstudio.decoding.grid import GridImageDecoder
from sl_nerfstudio.decoding.grid_edges import EdgeView, edge_view, moved_coords
from sl_nerfstudio.decoding.grid_phases import from_pattern
from sl_nerfstudio.pattern.grid import GridPattern
from training.appearance import illuminate, random_difficulty
from training.camera import photograph
from training.patterns import CELLS, draw_pattern, random_grid
from training.surfaces import Surface, random_surface

WRONG = 0.1  # periods
_SAMPLING = 2
_ONLY_WRONG = 0.5  # share: a capture that shows more is one that nobody could read, and is left out


@dataclass(frozen=True)
class EdgeCapture:
    """What the decoder knows about a capture, and the true coordinates, in periods; NaN where the pattern is not."""

    view: EdgeView
    true: Float32[ndarray, "h w 2"]


def painted_capture(seed: int, number: int, size: int) -> EdgeCapture | None:
    """A random coordinate field of `size` pixels a side; None if it cannot be decoded."""
    rng = np.random.default_rng([seed, 7, number])
    grid = random_grid(rng)
    surface, hard = random_surface(rng, size, _SAMPLING, CELLS), random_difficulty(rng)
    light = illuminate(rng, surface, draw_pattern(grid), hard)
    image = photograph(rng, light, size, _SAMPLING, hard.blur, hard.noise)
    return edge_capture(image, grid, (_at_pixels(surface) + np.float32(0.5)) * np.float32(grid.period))


def edge_capture(
    image: Float32[ndarray, "h w"], grid: GridPattern, true: Float32[ndarray, "h w 2"]
) -> EdgeCapture | None:
    """A capture with its true pattern pixels, NaN where the pattern is not; None if it cannot be decoded."""
    decoder = GridImageDecoder(grid)
    try:
        found = decoder.detect(image)
    except DecodingError:
        return None
    evidence = decoder.examine(image, found)
    known = np.isfinite(evidence.fitted[..., 0])
    right = np.linalg.norm(evidence.fitted - true, axis=-1) < WRONG * grid.period
    if not known.any() or right[known].mean() < 1 - _ONLY_WRONG:
        return None
    turn, rectified = found.assignment.turn, found.rectified
    view = edge_view(evidence, rectified, turn, grid, decoder.drawn)
    return EdgeCapture(view, moved_coords(from_pattern(true, grid, turn), rectified, WRONG))


def _at_pixels(surface: Surface) -> Float32[ndarray, "s s 2"]:
    """Coordinates in periods of the pixels' centres; NaN where the pattern is not."""
    parts = [(slice(a, None, _SAMPLING), slice(b, None, _SAMPLING)) for a in (0, 1) for b in (0, 1)]
    coords = np.mean([surface.coords[part] for part in parts], axis=0)
    layer, lit = (np.stack([values[part] for part in parts]) for values in (surface.layer, surface.lit))
    whole = (layer == layer[0]).all(0) & (lit == lit[0]).all(0)
    coords = np.where(whole[..., None], coords, surface.coords[parts[0]])
    return np.where((lit.mean(0) > 0.5)[..., None], coords, np.float32(np.nan)).astype(np.float32)


def save_capture(path: Path, capture: EdgeCapture) -> None:
    """Write a capture; channels in half precision."""
    view = capture.view
    np.savez(path.with_suffix(".new.npz"), measured=view.measured.astype(np.float16), fitted=view.fitted,
             read=view.read, continued=view.continued.astype(np.float16), true=capture.true)  # fmt: skip
    path.with_suffix(".new.npz").replace(path)


def load_capture(path: Path) -> EdgeCapture:
    """The capture that `save_capture` wrote."""
    with np.load(path) as stored:
        view = EdgeView(stored["measured"], stored["fitted"], stored["read"], stored["continued"])
        return EdgeCapture(view, stored["true"])
