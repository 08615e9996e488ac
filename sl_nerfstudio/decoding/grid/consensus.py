"""From each node's own opinion to assignments that hang together.

The graph network judges every node by its neighbourhood. Nodes joined by an edge must lie one place apart in the
pattern, all in the same quarter turn: opinions travel along edges, and nodes that then agree with their neighbours
form pieces. Each piece is held against the whole pattern: where the symbols of all its nodes fit one place much
better than any other, it lies there; else it is given up. Nodes at the rim of a piece take the place that the piece
gives them.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int8, Int32
from numpy import ndarray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from sl_nerfstudio.decoding.grid.graph import STEPS, GridGraph

_ROUNDS = 4
_TRUST = 0.7  # what a neighbour's opinion weighs
_LEAST_PIECE = 4
_GROWTH = 3  # rounds of taking over places at the rim of pieces
_SURE = 3.0  # log-odds of a piece's place against all other places, and none, together
_MISREAD = 0.15  # share of the symbols that may be wrong however sure the network is
_FLOOR = -12.0  # no opinion is stronger than this against a place


@dataclass(frozen=True)
class Assignment:
    """The pattern's place of each node in the array as the view shows it, turned by `turn` quarter turns."""

    turn: int  # clockwise
    place: Int32[ndarray, "n 2"]  # (row, column), -1 where unknown
    piece: Int32[ndarray, "n"]  # number of the connected piece, -1 where unknown

    @property
    def known(self) -> Bool[ndarray, "n"]:
        """Nodes that have a place."""
        return self.place[:, 0] >= 0


def choose_turn(log_probability: Float32[ndarray, "n m"], turn_of: ndarray) -> int:
    """The quarter turn that all nodes together find most probable; each node's best place counts."""
    sums = [
        np.sum(np.maximum(log_probability[:, turn_of == turn].max(-1), _FLOOR)) if (turn_of == turn).any() else -np.inf
        for turn in range(4)
    ]
    return int(np.argmax(sums))


def agree(
    log_probability: Float32[ndarray, "n rows columns"],
    graph: GridGraph,
    codes: Int8[ndarray, "rows columns"],
    turn: int,
) -> Assignment:
    """Assignments for one quarter turn.

    `log_probability` is each node's of every place in the turned array `codes`.
    """
    n, _, columns = log_probability.shape
    own = np.maximum(log_probability, _FLOOR)
    belief = own
    for _ in range(_ROUNDS):
        belief = _exchange(own, belief, graph.neighbour)
    best = belief.reshape(n, -1).argmax(-1)
    place = np.stack([best // columns, best % columns], -1).astype(np.int32)
    piece = _pieces(place, graph.neighbour)
    for number in np.unique(piece[piece >= 0]):
        inside = piece == number
        place[inside] = _settled(place[inside], graph.score[inside], codes)
    for _ in range(_GROWTH):
        place = _grow(place, graph.neighbour, codes.shape)
    place = _supported(place, graph, codes)
    return Assignment(turn, place, _pieces(place, graph.neighbour))


def _supported(
    place: Int32[ndarray, "n 2"], graph: GridGraph, codes: Int8[ndarray, "rows columns"]
) -> Int32[ndarray, "n 2"]:
    """Forget nodes around which the symbols speak against the places: beyond a border that lines seem to cross."""
    known = place[:, 0] >= 0
    symbol = codes[np.maximum(place[:, 0], 0), np.maximum(place[:, 1], 0)]
    likelihood = _likelihood(graph.score)[np.arange(len(place)), symbol]
    evidence = np.where(known, likelihood + np.log(graph.score.shape[1]), 0.0)
    for _ in range(2):  # of the node, of its neighbours in the piece, and of theirs
        spread = evidence.copy()
        for direction, step in enumerate(STEPS):
            other = graph.neighbour[:, direction]
            joined = known & (other >= 0) & (place[other] == place + np.array(step)).all(-1)
            spread[joined] += evidence[other[joined]]
        evidence = spread
    return np.where((known & (evidence > 0))[:, None], place, -1).astype(np.int32)


def _likelihood(score: Float32[ndarray, "n 5"]) -> Float32[ndarray, "n 5"]:
    """Log probability of each symbol: however sure the network is, it may have misread."""
    return np.log((1 - _MISREAD) * score + _MISREAD / score.shape[1]).astype(np.float32)


def _settled(
    place: Int32[ndarray, "k 2"], score: Float32[ndarray, "k 5"], codes: Int8[ndarray, "rows columns"]
) -> Int32[ndarray, "k 2"]:
    """The places of a piece's nodes, moved together to where their symbols fit; -1 where no place fits best by far."""
    lost = np.full_like(place, -1)
    if len(place) < _LEAST_PIECE:
        return lost
    first, extent = place.min(0), place.max(0) - place.min(0)
    shape = np.array(codes.shape) - extent  # places of the piece's upper left corner that keep it inside
    fit = np.zeros(shape, dtype=np.float64)
    for (i, j), row in zip(place - first, _likelihood(score), strict=True):
        fit += row[codes[i : i + shape[0], j : j + shape[1]]]
    top = np.unravel_index(int(fit.argmax()), fit.shape)
    others = np.exp(fit - fit[top])
    others[top] = 0
    # or the piece shows no part of this pattern, and fits best at one of so many places by chance
    chance = fit.size * np.exp(np.minimum(-len(place) * np.log(score.shape[1]) - fit[top], 50))
    if -np.log(max(others.sum() + chance, 1e-30)) < _SURE:
        return lost
    return (place - first + np.array(top)).astype(np.int32)


def _exchange(
    own: Float32[ndarray, "n rows columns"],
    belief: Float32[ndarray, "n rows columns"],
    neighbour: Int32[ndarray, "n 4"],
) -> Float32[ndarray, "n rows columns"]:
    """Add to each node's own opinion what its neighbours believe, moved by one place."""
    n, rows, columns = own.shape
    message = np.full((n + 1, rows + 2, columns + 2), _FLOOR, dtype=np.float32)
    peak = belief.reshape(n, -1).max(-1)[:, None, None]
    message[:n, 1:-1, 1:-1] = np.maximum(belief - peak, _FLOOR)
    message[n] = 0
    total = own.copy()
    for direction, (di, dj) in enumerate(STEPS):
        # the neighbour at (di, dj) believing in (r + di, c + dj) speaks for (r, c)
        shifted = message[:, 1 + di : 1 + di + rows, 1 + dj : 1 + dj + columns]
        total += np.float32(_TRUST) * np.maximum(shifted[neighbour[:, direction]], _FLOOR / 2)
    return total


def _pieces(place: Int32[ndarray, "n 2"], neighbour: Int32[ndarray, "n 4"]) -> Int32[ndarray, "n"]:
    """Connected components over the edges whose ends lie one place apart as the edge says; -1 without a place."""
    n = len(place)
    pairs = []
    for direction in (0, 1):
        a = np.nonzero(neighbour[:, direction] >= 0)[0]
        b = neighbour[a, direction]
        holds = (place[b] == place[a] + np.array(STEPS[direction])).all(-1) & (place[a, 0] >= 0)
        pairs.append(np.stack([a[holds], b[holds]]))
    a, b = np.concatenate(pairs, 1)
    _, label = connected_components(coo_matrix((np.ones(len(a), dtype=bool), (a, b)), shape=(n, n)), directed=False)
    return np.where(place[:, 0] >= 0, label, -1).astype(np.int32)


def _grow(
    place: Int32[ndarray, "n 2"], neighbour: Int32[ndarray, "n 4"], shape: tuple[int, ...]
) -> Int32[ndarray, "n 2"]:
    """Give nodes without a place the one that all their placed neighbours agree on."""
    padded = np.vstack([place, np.full((1, 2), -1, dtype=np.int32)])
    said = np.stack([padded[neighbour[:, d]] - np.array(STEPS[d]) for d in range(4)], 1)
    speaks = padded[neighbour][..., 0] >= 0
    first = said[np.arange(len(place)), speaks.argmax(1)]
    unanimous = ((said == first[:, None]).all(-1) | ~speaks).all(1) & speaks.any(1)
    inside = (first >= 0).all(-1) & (first < np.array(shape)).all(-1)
    taken = (place[:, 0] < 0) & unanimous & inside
    return np.where(taken[:, None], first, place).astype(np.int32)
