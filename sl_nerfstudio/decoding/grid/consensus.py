"""From the probabilities of single nodes to consistent assignments.

The graph network judges every node by its neighbourhood. Nodes joined by an edge must be one place apart in the
pattern, all in the same quarter turn: beliefs are passed along edges, and nodes that then agree with their neighbours
form pieces. Each piece is compared with the whole pattern: where the symbols of all its nodes fit one place much better
than any other, it gets that place; otherwise it is dropped. Nodes next to a piece get the place that follows from it.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int8, Int32
from numpy import ndarray

from sl_nerfstudio.decoding.grid.graph import STEPS, GridGraph
from sl_nerfstudio.decoding.grid.likelihood import symbol_log_likelihood
from sl_nerfstudio.geometry.connectivity import component_labels

# Passing beliefs along edges.
_ROUNDS = 4
_TRUST = 0.7  # weight of a neighbour's belief
_FLOOR = -12.0  # the lowest log probability: no node excludes a place more than this
# Pieces.
LEAST_PIECE = 4  # nodes
_LEAST_LOG_ODDS = 3.0  # that no piece of the graph is at a wrong place by chance
_GROWTH = 3  # rounds in which places spread from pieces to their neighbours
_CHECKED = 2  # edges from a node within which symbols must agree with the places


@dataclass(frozen=True)
class Assignment:
    """The place of each node in the pattern's array, turned by `turn` quarter turns as it appears in the image."""

    turn: int  # clockwise
    place: Int32[ndarray, "n 2"]  # (row, column); -1 where unknown

    @property
    def known(self) -> Bool[ndarray, "n"]:
        """Nodes that have a place."""
        return self.place[:, 0] >= 0


def choose_turn(best: Float32[ndarray, "n 4"]) -> int:
    """The quarter turn in which most nodes are recognised; `best` is each node's highest log probability in each.

    A sum of probabilities, not of their logarithms: many nodes of another texture must not outvote a few certain ones.
    """
    return int(np.argmax(np.exp(best).sum(0)))


def believe(
    log_probability: Float32[ndarray, "n rows columns"], neighbour: Int32[ndarray, "n 4"]
) -> Int32[ndarray, "n 2"]:
    """The place (row, column) of each node that is most probable by itself and its neighbours.

    `log_probability` is that of every place in the turned array, for each node.
    """
    n, _, columns = log_probability.shape
    own = np.maximum(log_probability, _FLOOR)
    belief = own
    for _ in range(_ROUNDS):
        belief = _exchange(own, belief, neighbour)
    best = belief.reshape(n, -1).argmax(-1)
    return np.stack([best // columns, best % columns], -1).astype(np.int32)


def agree(
    place: Int32[ndarray, "n 2"], graph: GridGraph, codes: Int8[ndarray, "rows columns"]
) -> Int32[ndarray, "n 2"]:
    """The places on which pieces of the graph agree, and which their symbols prove; -1 for other nodes.

    `place` is what each node believes, and `codes` the turned array.
    """
    place, piece = place.copy(), _pieces(place, graph.neighbour)
    sizes = np.bincount(piece[piece >= 0], minlength=1)
    place[sizes[piece] < LEAST_PIECE] = -1
    judged = np.nonzero(sizes >= LEAST_PIECE)[0]
    # The more pieces there are, the more often one of them fits by chance.
    least = _LEAST_LOG_ODDS + np.log(max(len(judged), 1))
    for number in judged:
        inside = piece == number
        place[inside] = _best_place(place[inside], graph.score[inside], codes, float(least))
    for _ in range(_GROWTH):
        place = _grow(place, graph.neighbour, codes.shape)
    return _without_contradicted(place, graph, codes)


def _without_contradicted(
    place: Int32[ndarray, "n 2"], graph: GridGraph, codes: Int8[ndarray, "rows columns"]
) -> Int32[ndarray, "n 2"]:
    """Drop nodes around which the symbols contradict the places: lines may seem to continue on another surface."""
    known = place[:, 0] >= 0
    symbol = codes[np.maximum(place[:, 0], 0), np.maximum(place[:, 1], 0)]
    log_likelihood = symbol_log_likelihood(graph.score)[np.arange(len(place)), symbol]
    log_ratio = np.where(known, log_likelihood + np.log(graph.score.shape[1]), 0.0)
    for _ in range(_CHECKED):  # sums over the node, its neighbours in the piece, and theirs
        spread = log_ratio.copy()
        for direction, step in enumerate(STEPS):
            other = graph.neighbour[:, direction]
            joined = known & (other >= 0) & (place[other] == place + np.array(step)).all(-1)
            spread[joined] += log_ratio[other[joined]]
        log_ratio = spread
    return np.where((known & (log_ratio > 0))[:, None], place, -1).astype(np.int32)


def _best_place(
    place: Int32[ndarray, "k 2"], score: Float32[ndarray, "k 5"], codes: Int8[ndarray, "rows columns"], least: float
) -> Int32[ndarray, "k 2"]:
    """The places of a piece's nodes, shifted together to where their symbols fit; -1 if no place is clearly best."""
    nowhere = np.full_like(place, -1)
    first, extent = place.min(0), place.max(0) - place.min(0)
    shape = np.array(codes.shape) - extent  # places of its upper left corner with all of it inside
    fit = np.zeros(shape, dtype=np.float64)
    for (i, j), row in zip(place - first, symbol_log_likelihood(score), strict=True):
        fit += row[codes[i : i + shape[0], j : j + shape[1]]]
    top = np.unravel_index(int(fit.argmax()), fit.shape)
    others = np.exp(fit - fit[top])
    others[top] = 0
    # The piece may show no part of this pattern, and fit one of the many places by chance.
    chance = fit.size * np.exp(np.minimum(-len(place) * np.log(score.shape[1]) - fit[top], 50))
    if -np.log(max(others.sum() + chance, 1e-30)) < least:
        return nowhere
    return (place - first + np.array(top)).astype(np.int32)


def _exchange(
    own: Float32[ndarray, "n rows columns"],
    belief: Float32[ndarray, "n rows columns"],
    neighbour: Int32[ndarray, "n 4"],
) -> Float32[ndarray, "n rows columns"]:
    """Add to each node's own log probability the beliefs of its neighbours, shifted by one place."""
    n, rows, columns = own.shape
    message = np.full((n + 1, rows + 2, columns + 2), _FLOOR, dtype=np.float32)
    peak = belief.reshape(n, -1).max(-1)[:, None, None]
    message[:n, 1:-1, 1:-1] = np.maximum(belief - peak, _FLOOR)
    message[n] = 0
    total = own.copy()
    for direction, (di, dj) in enumerate(STEPS):
        # A neighbour at (di, dj) that believes in (r + di, c + dj) supports (r, c).
        shifted = message[:, 1 + di : 1 + di + rows, 1 + dj : 1 + dj + columns]
        total += np.float32(_TRUST) * np.maximum(shifted[neighbour[:, direction]], _FLOOR / 2)
    return total


def _pieces(place: Int32[ndarray, "n 2"], neighbour: Int32[ndarray, "n 4"]) -> Int32[ndarray, "n"]:
    """Connected components over the edges whose ends are one place apart in its direction; -1 without a place."""
    n = len(place)
    pairs = []
    for direction in (0, 1):
        a = np.nonzero(neighbour[:, direction] >= 0)[0]
        b = neighbour[a, direction]
        holds = (place[b] == place[a] + np.array(STEPS[direction])).all(-1) & (place[a, 0] >= 0)
        pairs.append(np.stack([a[holds], b[holds]]))
    a, b = np.concatenate(pairs, 1)
    label = component_labels(a, b, n)
    return np.where(place[:, 0] >= 0, label, -1).astype(np.int32)


def _grow(
    place: Int32[ndarray, "n 2"], neighbour: Int32[ndarray, "n 4"], shape: tuple[int, ...]
) -> Int32[ndarray, "n 2"]:
    """Give nodes without a place the one on which all their neighbours with a place agree."""
    padded = np.vstack([place, np.full((1, 2), -1, dtype=np.int32)])
    implied = np.stack([padded[neighbour[:, d]] - np.array(STEPS[d]) for d in range(4)], 1)
    known = padded[neighbour][..., 0] >= 0
    first = implied[np.arange(len(place)), known.argmax(1)]
    unanimous = ((implied == first[:, None]).all(-1) | ~known).all(1) & known.any(1)
    inside = (first >= 0).all(-1) & (first < np.array(shape)).all(-1)
    new = (place[:, 0] < 0) & unanimous & inside
    return np.where(new[:, None], first, place).astype(np.int32)
