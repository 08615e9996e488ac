"""Random damaged grid graphs: nodes of a pattern after occlusion, misread symbols and wrong edges."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int8, Int32
from numpy import ndarray
from scipy.ndimage import gaussian_filter

from sl_nerfstudio.decoding.grid_graph import STEPS, GridGraph
from sl_nerfstudio.pattern.codes import SYMBOLS, rotate_codes


@dataclass(frozen=True)
class Damage:
    """Shares of nodes and edges that are damaged."""

    misread: float  # nodes whose most probable symbol is wrong
    missing: float  # nodes not found
    cut: float = 0.03  # edges not found
    torn: bool = False  # the surface has an edge across which wrong nodes were joined


@dataclass(frozen=True)
class DamagedGraph:
    """A graph as `decoding.grid.graph` would find it, and the true places of its nodes."""

    score: Float32[ndarray, "n 5"]
    neighbour: Int32[ndarray, "n 4"]
    turn: int  # clockwise quarter turns by which the view shows the pattern
    place: Int32[ndarray, "n 2"]  # true (row, column) in the turned array

    def as_grid(self) -> GridGraph:
        """The graph alone; its places in the image have no meaning here."""
        return GridGraph(self.place[:, ::-1].astype(np.float32), self.neighbour, self.score)


def random_damage(rng: np.random.Generator) -> Damage:
    """Draw damage, from hardly any to more than can be corrected."""
    return Damage(
        float(rng.uniform(0, 0.45)), float(rng.uniform(0, 0.4)), float(rng.uniform(0, 0.1)), bool(rng.random() < 0.4)
    )


def random_codes(rng: np.random.Generator) -> Int8[ndarray, "rows columns"]:
    """A code array of random size."""
    return rng.integers(0, SYMBOLS, rng.integers(16, 44, 2)).astype(np.int8)


def damage_graph(
    rng: np.random.Generator, codes: Int8[ndarray, "rows columns"], damage: Damage, turn: int, share: float = 0.6
) -> DamagedGraph:
    """A random part of a pattern, about `share` of it in smooth patches, damaged."""
    turned = rotate_codes(codes, turn)
    seen = _patches(rng, turned.shape, share) & (rng.random(turned.shape) >= damage.missing)
    if damage.torn:
        index, true = _with_tear(rng, seen)
    else:
        index, true = _numbered(seen), np.argwhere(seen)
    symbol = turned[true[:, 0], true[:, 1]]
    return DamagedGraph(
        soft_scores(rng, symbol, damage.misread), _edges(rng, index, damage.cut), turn, true.astype(np.int32)
    )


def soft_scores(rng: np.random.Generator, symbol: Int8[ndarray, "n"], misread: float) -> Float32[ndarray, "n 5"]:
    """Probabilities like those of a network: usually high where it is right, and lower where it is wrong."""
    n = len(symbol)
    wrong = rng.random(n) < misread
    read = np.where(wrong, (symbol + rng.integers(1, SYMBOLS, n)) % SYMBOLS, symbol)
    # Misread symbols are less certain, by an amount that differs from image to image.
    contrast = rng.uniform(0.2, 1.0)
    uncertainty = np.clip(rng.beta(1.2, 3.0, n) + contrast * wrong * rng.beta(2.0, 2.0, n), 0, 1)
    rest = rng.dirichlet(np.full(SYMBOLS, 0.6), n)
    rest[np.arange(n), symbol] += wrong * rng.random(n) * 0.7  # the truth is often the second choice
    rest[np.arange(n), read] = 0
    rest /= np.maximum(rest.sum(-1, keepdims=True), 1e-9)
    score = rest * (0.6 * uncertainty)[:, None]
    score[np.arange(n), read] = 0
    others = score.max(-1)
    score[np.arange(n), read] = np.maximum(1 - score.sum(-1), others + 1e-3)
    return (score / score.sum(-1, keepdims=True)).astype(np.float32)


def _patches(rng: np.random.Generator, shape: tuple[int, ...], share: float) -> Bool[ndarray, "rows columns"]:
    smooth = gaussian_filter(rng.standard_normal(shape), rng.uniform(2.0, 6.0))
    return smooth > np.quantile(smooth, 1 - share)


def _numbered(seen: Bool[ndarray, "rows columns"]) -> Int32[ndarray, "rows columns"]:
    index = np.full(seen.shape, -1, dtype=np.int32)
    index[seen] = np.arange(seen.sum(), dtype=np.int32)
    return index


def _with_tear(
    rng: np.random.Generator, seen: Bool[ndarray, "rows columns"]
) -> tuple[Int32[ndarray, "rows columns"], Int32[ndarray, "n 2"]]:
    """On one side of a curved line, nodes belong to another part of the pattern than those on the other side."""
    rows, columns = seen.shape
    i, j = np.mgrid[:rows, :columns]
    line = rng.uniform(0.25, 0.75) * columns + 3 * np.sin(i * rng.uniform(0.1, 0.6)) + rng.uniform(-0.5, 0.5) * i
    slip = rng.integers(-5, 6, 2)
    true_i, true_j = np.where(j > line, i + slip[0], i), np.where(j > line, j + slip[1], j)
    seen = seen & (true_i >= 0) & (true_i < rows) & (true_j >= 0) & (true_j < columns)
    return _numbered(seen), np.stack([true_i[seen], true_j[seen]], -1)


def _edges(rng: np.random.Generator, index: Int32[ndarray, "rows columns"], cut: float) -> Int32[ndarray, "n 4"]:
    """Neighbours in the layout, each edge missing with probability `cut`."""
    n = int(index.max(initial=-1)) + 1
    neighbour = np.full((n, 4), -1, dtype=np.int32)
    padded = np.pad(index, 1, constant_values=-1)
    for direction in (0, 1):
        di, dj = STEPS[direction]
        other = padded[1 + di : 1 + di + index.shape[0], 1 + dj : 1 + dj + index.shape[1]]
        joined = (index >= 0) & (other >= 0) & (rng.random(index.shape) >= cut)
        neighbour[index[joined], direction] = other[joined]
        neighbour[other[joined], direction + 2] = index[joined]
    return neighbour
