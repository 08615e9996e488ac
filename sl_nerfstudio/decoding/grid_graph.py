"""The graph network that recognises a node by the symbols around it.

Nodes of a capture and nodes of the pattern go through the same network. A node of the capture is the node of the
pattern, in one of its four quarter turns, with the most similar feature. So one set of weights serves every pattern,
and the geometry of camera and projector is not needed.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int8, Int32, Int64
from numpy import ndarray
from scipy.ndimage import maximum_filter, uniform_filter1d
from scipy.spatial import KDTree
from scipy.special import log_softmax, softmax
from torch import Tensor, nn

from sl_nerfstudio.decoding.decoder import Coords, Layer
from sl_nerfstudio.geometry.numerics import component_labels
from sl_nerfstudio.parallel import compiled
from sl_nerfstudio.pattern.codes import SYMBOLS, rotate_codes
from sl_nerfstudio.pattern.grid import gaussian_window

# How well coordinates agree with the symbols that the network read around them.
#
# Phases can run on smoothly from one surface to another whose lines happen to continue those of the first; the
# symbols show that the second one is elsewhere in the pattern. Even where the network is certain, it may have misread
# a symbol: all likelihoods allow for that.

_MISREAD = 0.15  # share of the symbols that may be wrong, however certain the network is
_WINDOW = 0.7  # periods over which symbols are averaged
_READABLE = 0.3  # periods from a node within which its symbol can be read


def symbol_log_likelihood(score: Float32[ndarray, "n 5"]) -> Float32[ndarray, "n 5"]:
    """Log probability of each symbol at each node, from the network's probabilities."""
    return np.log((1 - _MISREAD) * score + _MISREAD / score.shape[1]).astype(np.float32)


def symbol_log_ratio(
    coords: Coords,
    codes: Int8[ndarray, "rows columns"],
    symbol: Float32[ndarray, "5 a b"],
    to_map: Float64[ndarray, "2 3"],
    pixels_a_period: float,
) -> Layer:
    """Mean log-likelihood ratio, around each pixel, of its coordinates against random symbols; 0 where none was read.

    `coords` are in periods within the array `codes`, `symbol` are the network's logits, and `to_map` maps pixels
    (x, y, first centre 0) to their places.
    """
    probability = np.exp(log_softmax(symbol, axis=0))
    ratio = np.log((1 - _MISREAD) * symbol.shape[0] * probability + _MISREAD)
    sums = np.zeros((*coords.shape[:2], 2), dtype=np.float32)
    _weigh(coords, codes, ratio, to_map, sums)
    sums = gaussian_window(sums, _WINDOW * pixels_a_period)
    return (sums[..., 1] / np.maximum(sums[..., 0], 1e-6)).astype(np.float32)


@compiled
def _weigh(coords: ndarray, codes: ndarray, ratio: ndarray, to_map: ndarray, sums: ndarray) -> None:
    """Weight of each pixel with coordinates, and its share of the sum: the ratio of the nearest node's symbol there."""
    h, w = coords.shape[:2]
    for row in range(h):
        for column in range(w):
            x, y = coords[row, column, 0], coords[row, column, 1]
            if np.isnan(x):
                continue
            j, i = round(x), round(y)
            weight = math.exp(-((x - j) ** 2 + (y - i) ** 2) / _READABLE**2)
            j, i = min(max(j, 0), codes.shape[1] - 1), min(max(i, 0), codes.shape[0] - 1)
            mx = round(to_map[0, 0] * column + to_map[0, 1] * row + to_map[0, 2])
            my = round(to_map[1, 0] * column + to_map[1, 1] * row + to_map[1, 2])
            mx, my = min(max(mx, 0), ratio.shape[2] - 1), min(max(my, 0), ratio.shape[1] - 1)
            sums[row, column, 0], sums[row, column, 1] = weight, weight * ratio[codes[i, j], my, mx]


# The grid graph of a capture: crossings of lines, and which of them are neighbours along a line.
#
# Directions (right, down, left, up) are those of the rectified image, in which the pattern may be turned by any
# number of quarter turns.

RIGHT, DOWN, LEFT, UP = range(4)
STEPS = ((0, 1), (1, 0), (0, -1), (-1, 0))
"""(row, column) of each direction."""
REACH = 2
OFFSETS = tuple((i, j) for i in range(-REACH, REACH + 1) for j in range(-REACH, REACH + 1))
"""(row, column) of the places around a node that `neighbourhoods` looks up."""
# Nodes.
_LEAST_CREST = 0.9  # of cos + cos, which is 2 at a perfect crossing
_LEAST_MASK = 0.5  # probability that the pattern is there
_LARGEST_SHIFT = 1.5  # of a node from the place where the crest is highest, places
# Edges.
_TOLERANCE = 0.3  # periods by which a neighbour may be off its expected place
_SAMPLES = 7  # places between two nodes at which the phase is followed
_LEAST_MASK_BETWEEN = 0.3  # probability that the pattern is there, at all of them
_INTERRUPTED = 9.0  # periods: stands for a phase that cannot be followed


@dataclass(frozen=True)
class PhaseMaps:
    """Mask, phases and symbols of a rectified image at places one unit apart; phases in periods, 0 at the nodes."""

    mask: Layer  # probability
    vector: Float32[ndarray, "4 h w"]  # cosine and sine in x, then in y
    symbol: Float32[ndarray, "5 h w"]  # logits
    gradient: Float32[ndarray, "2 2 h w"]  # of the phases in x and y, along x and y; periods per unit


@dataclass(frozen=True)
class GridGraph:
    """Nodes and their neighbours; -1 stands for none."""

    place: Float32[ndarray, "n 2"]  # (x, y) in the maps' units
    neighbour: Int32[ndarray, "n 4"]
    score: Float32[ndarray, "n 5"]  # probability of each symbol

    def part(self, index: Int32[ndarray, "k"]) -> "GridGraph":
        """The nodes of the given numbers, with the edges between them."""
        number = np.full(len(self.place) + 1, -1, dtype=np.int32)  # the last stands for no neighbour
        number[index] = np.arange(len(index), dtype=np.int32)
        return GridGraph(self.place[index], number[self.neighbour[index]], self.score[index])


def phase_maps(mask: Layer, vector: Float32[ndarray, "4 h w"], symbol: Float32[ndarray, "5 h w"]) -> PhaseMaps:
    """The network's output with the gradients of the phases, smoothed over 3 x 3 places."""
    gradient = np.empty((2, 2, *mask.shape), dtype=np.float32)
    for axis in range(2):
        wave = (vector[2 * axis] + 1j * vector[2 * axis + 1]) * mask
        for along in range(2):
            # The mean turn from one place to the next; unlike differences of sines it is right for short periods, too.
            turn = np.zeros_like(wave)
            ahead, here = ((..., slice(1, None)), (..., slice(None, -1))) if along == 0 else (slice(1, None), slice(-1))
            turn[here] = wave[ahead] * np.conj(wave[here])
            # Four differences along the axis: from two places before to two places after.
            mean = uniform_filter1d(uniform_filter1d(turn, 4, axis=1 - along), 3, axis=along)
            gradient[axis, along] = np.angle(mean) / (2 * np.pi)
    return PhaseMaps(mask, vector, symbol, gradient)


def build_graph(maps: PhaseMaps) -> GridGraph:
    """Find the crossings, and join neighbours if the phases advance by one period from one to the other."""
    place, jacobian = _find_nodes(maps)
    neighbour = np.full((len(place), 4), -1, dtype=np.int32)
    if len(place) > 1:
        tree = KDTree(place)
        for direction in (RIGHT, DOWN):
            _join(maps, place, jacobian, tree, neighbour, direction)
    return GridGraph(place, neighbour, _symbol_scores(maps, place))


def component_of(neighbour: Int32[ndarray, "n 4"]) -> Int32[ndarray, "n"]:
    """Number of the connected component that each node lies in."""
    node, direction = np.nonzero(neighbour >= 0)
    return component_labels(node, neighbour[node, direction], len(neighbour)).astype(np.int32)


def without_fragments(graph: GridGraph, least: int) -> GridGraph:
    """The components of at least `least` nodes: single crossings are seen in any texture."""
    component = component_of(graph.neighbour)
    size = np.bincount(component, minlength=1)
    return graph.part(np.nonzero(size[component] >= least)[0].astype(np.int32))


def _find_nodes(maps: PhaseMaps) -> tuple[Float32[ndarray, "n 2"], Float32[ndarray, "n 2 2"]]:
    """Places where both phases are zero, and the Jacobian of the phases there."""
    crest = (maps.vector[0] + maps.vector[2]) * maps.mask
    order = np.arange(crest.size, dtype=np.float32).reshape(crest.shape)
    crest = (crest - 1e-5 * order / crest.size).astype(np.float32)  # no ties
    peak = (crest == maximum_filter(crest, 3)) & (crest > _LEAST_CREST) & (maps.mask > _LEAST_MASK)
    row, column = np.nonzero(peak)
    jacobian = np.moveaxis(maps.gradient[:, :, row, column], -1, 0)
    vector = maps.vector[:, row, column]
    phase = np.stack([np.arctan2(vector[1], vector[0]), np.arctan2(vector[3], vector[2])], -1) / (2 * np.pi)
    sound = np.abs(np.linalg.det(jacobian)) > 1e-3
    jacobian, phase, row, column = jacobian[sound], phase[sound], row[sound], column[sound]
    shift = -np.linalg.solve(jacobian, phase[..., None])[..., 0]
    place = (np.stack([column, row], -1) + np.clip(shift, -_LARGEST_SHIFT, _LARGEST_SHIFT)).astype(np.float32)
    kept = _without_twins(place, jacobian, crest[row, column])
    return place[kept], jacobian[kept]


def _without_twins(
    place: Float32[ndarray, "n 2"], jacobian: Float32[ndarray, "n 2 2"], crest: Float32[ndarray, "n"]
) -> Bool[ndarray, "n"]:
    """Keep only the highest of peaks that are less than half a period apart."""
    kept = np.ones(len(place), dtype=bool)
    if len(place) < 2:
        return kept
    period = 1 / max(float(np.median(np.abs(np.linalg.det(jacobian)) ** 0.5)), 0.02)
    pairs = KDTree(place).query_pairs(period, output_type="ndarray")
    apart = np.einsum("nij,nj->ni", jacobian[pairs[:, 0]], place[pairs[:, 1]] - place[pairs[:, 0]])
    for a, b in pairs[np.abs(apart).max(-1) < 0.5]:
        if kept[a] and kept[b]:
            kept[a if crest[a] < crest[b] else b] = False
    return kept


def _join(
    maps: PhaseMaps,
    place: Float32[ndarray, "n 2"],
    jacobian: Float32[ndarray, "n 2 2"],
    tree: KDTree,
    neighbour: Int32[ndarray, "n 4"],
    direction: int,
) -> None:
    """Fill in the neighbours in one direction, and the nodes themselves as neighbours in the opposite direction."""
    step = np.array(STEPS[direction][::-1], dtype=np.float32)  # (x, y)
    expected = place + np.linalg.solve(jacobian, np.broadcast_to(step[:, None], (len(place), 2, 1)))[..., 0]
    choices = min(3, len(place))
    _, found = tree.query(np.where(np.isfinite(expected), expected, -1e6), k=choices)
    found = found.reshape(len(place), choices)
    source = np.repeat(np.arange(len(place)), choices)
    target = found.reshape(-1)
    move = place[target] - place[source]
    forth = np.abs(np.einsum("nij,nj->ni", jacobian[source], move) - step).max(-1)
    back = np.abs(np.einsum("nij,nj->ni", jacobian[target], move) - step).max(-1)
    near = (np.minimum(forth, back) < _TOLERANCE) & (np.maximum(forth, back) < 2 * _TOLERANCE) & (source != target)
    source, target, cost = source[near], target[near], (forth + back)[near]
    error = np.abs(_phase_along(maps, place[source], place[target]) - step).max(-1)
    good = error < _TOLERANCE
    order = np.argsort((cost + error)[good], kind="stable")
    opposite = (direction + 2) % 4
    for a, b in zip(source[good][order], target[good][order], strict=True):
        if neighbour[a, direction] < 0 and neighbour[b, opposite] < 0:
            neighbour[a, direction], neighbour[b, opposite] = b, a


def _phase_along(
    maps: PhaseMaps, start: Float32[ndarray, "n 2"], end: Float32[ndarray, "n 2"]
) -> Float32[ndarray, "n 2"]:
    """Periods by which the phases advance from one place to the other; `_INTERRUPTED` where the pattern is not seen."""
    h, w = maps.mask.shape
    t = np.linspace(0, 1, _SAMPLES, dtype=np.float32)
    way = start[:, None] + t[:, None] * (end - start)[:, None]
    column = np.clip(np.rint(way[..., 0]).astype(int), 0, w - 1)
    row = np.clip(np.rint(way[..., 1]).astype(int), 0, h - 1)
    vector = maps.vector[:, row, column]
    out = np.empty((len(start), 2), dtype=np.float32)
    for axis in range(2):
        c, s = vector[2 * axis], vector[2 * axis + 1]
        turn = np.arctan2(s[:, 1:] * c[:, :-1] - c[:, 1:] * s[:, :-1], c[:, 1:] * c[:, :-1] + s[:, 1:] * s[:, :-1])
        # Rounding to whole places leaves the phases at both ends different from zero.
        ends = np.arctan2(s[:, [0, -1]], c[:, [0, -1]])
        out[:, axis] = (turn.sum(-1) + ends[:, 0] - ends[:, 1]) / (2 * np.pi)
    out[(maps.mask[row, column] < _LEAST_MASK_BETWEEN).any(-1)] = _INTERRUPTED
    return out


def _symbol_scores(maps: PhaseMaps, place: Float32[ndarray, "n 2"]) -> Float32[ndarray, "n 5"]:
    """Probabilities from the mean logits of 3 x 3 places around each node."""
    h, w = maps.mask.shape
    logits = uniform_filter1d(uniform_filter1d(maps.symbol, 3, axis=1), 3, axis=2)
    column = np.clip(np.rint(place[:, 0]).astype(int), 0, w - 1)
    row = np.clip(np.rint(place[:, 1]).astype(int), 0, h - 1)
    at_node = logits[:, row, column].T
    return softmax(at_node, axis=-1).astype(np.float32)


def neighbourhoods(neighbour: Int32[ndarray, "n 4"]) -> Int32[ndarray, "n 25"]:
    """The node at each of `OFFSETS` from every node, by walks along edges; -1 where none arrives or walks disagree."""
    n = len(neighbour)
    padded = np.vstack([neighbour, np.full((1, 4), -1, dtype=np.int32)])  # steps from a missing node arrive nowhere
    table = {(0, 0): np.arange(n, dtype=np.int32)}
    nowhere = np.full(n, -1, dtype=np.int32)
    for offset in sorted(OFFSETS, key=lambda o: abs(o[0]) + abs(o[1])):
        if offset == (0, 0):
            continue
        arrived = nowhere
        for direction, (di, dj) in enumerate(STEPS):
            before = (offset[0] - di, offset[1] - dj)
            if before in table and abs(before[0]) + abs(before[1]) < abs(offset[0]) + abs(offset[1]):
                arrived = _agree(arrived, padded[table[before], direction])
        table[offset] = arrived
    for offset in OFFSETS:  # walks around missing nodes
        for direction, (di, dj) in enumerate(STEPS):
            before = (offset[0] - di, offset[1] - dj)
            if before in table:
                lost = table[offset] == -1
                table[offset] = np.where(lost, padded[table[before], direction], table[offset])
    return np.stack([np.maximum(table[offset], -1) for offset in OFFSETS], 1)


def _agree(a: Int32[ndarray, "n"], b: Int32[ndarray, "n"]) -> Int32[ndarray, "n"]:
    """The node at which either walk arrives; -2, which stays, where they arrive at different ones."""
    out = np.where(a == -1, b, a)
    return np.where((a != b) & (a >= 0) & (b >= 0), -2, out).astype(np.int32)


# From the probabilities of single nodes to consistent assignments.
#
# The graph network judges every node by its neighbourhood. Nodes joined by an edge must be one place apart in the
# pattern, all in the same quarter turn: beliefs are passed along edges, and nodes that then agree with their
# neighbours form pieces. Each piece is compared with the whole pattern: where the symbols of all its nodes fit one
# place much better than any other, it gets that place; otherwise it is dropped. Nodes next to a piece get the place
# that follows from it.

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


FEATURES = 160
_HIDDEN = 96


class GraphNetwork(nn.Module):
    """Two graph convolutions with one weight matrix for each place of a 5 x 5 neighbourhood.

    Walks along edges find the node at each place. Two rounds gather the symbols of up to 9 x 9 nodes.
    """

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Linear(len(OFFSETS) * (SYMBOLS + 1), _HIDDEN)
        self.second = nn.Linear(len(OFFSETS) * _HIDDEN, FEATURES)
        self.direct = nn.Linear(len(OFFSETS) * (SYMBOLS + 1), FEATURES)
        self.log_scale = nn.Parameter(torch.tensor(3.0))

    def forward(self, score: Float[Tensor, "n 5"], around: Int64[Tensor, "n 25"]) -> Float[Tensor, "n features"]:
        """Features of unit length; `around` is the graph's `neighbourhoods`."""
        present = torch.cat([score - 1 / SYMBOLS, torch.ones_like(score[:, :1])], 1)
        seen = _gather(present, around)
        hidden = torch.relu(self.first(seen))
        out = self.second(_gather(hidden, around)) + self.direct(seen)
        return nn.functional.normalize(out, dim=1)

    def logits(self, node: Float[Tensor, "n features"], candidate: Float[Tensor, "m features"]) -> Float[Tensor, "n m"]:
        """Similarity of each node to each candidate."""
        return self.log_scale.exp() * node @ candidate.T


def _gather(values: Float[Tensor, "n c"], around: Int64[Tensor, "n 25"]) -> Float[Tensor, "n k"]:
    """Values of the nodes around each node; zero where there is none."""
    padded = torch.cat([values, values.new_zeros(1, values.shape[1])])
    return padded[around].flatten(1)  # -1 is the last row, which is zero


@dataclass(frozen=True)
class TurnedPattern:
    """All nodes of a pattern in its four quarter turns, one after the other."""

    symbol: Int8[ndarray, "m"]
    around: Int32[ndarray, "m 25"]
    turn: Int8[ndarray, "m"]  # clockwise quarter turns
    place: Int32[ndarray, "m 2"]  # (row, column) in the turned array


def turned_pattern(codes: Int8[ndarray, "rows columns"]) -> TurnedPattern:
    """The complete graphs of a code array and of its quarter turns."""
    symbols, arounds, turns, places = [], [], [], []
    first = 0
    for turn in range(4):
        turned = rotate_codes(codes, turn)
        rows, columns = turned.shape
        i, j = (part.reshape(-1) for part in np.mgrid[:rows, :columns])
        around = np.empty((len(i), len(OFFSETS)), dtype=np.int32)
        for k, (di, dj) in enumerate(OFFSETS):
            inside = (i + di >= 0) & (i + di < rows) & (j + dj >= 0) & (j + dj < columns)
            around[:, k] = np.where(inside, first + (i + di) * columns + j + dj, -1)
        symbols.append(turned.reshape(-1))
        arounds.append(around)
        turns.append(np.full(len(i), turn, dtype=np.int8))
        places.append(np.stack([i, j], -1).astype(np.int32))
        first += len(i)
    return TurnedPattern(*(np.concatenate(parts) for parts in (symbols, arounds, turns, places)))


def one_hot(symbol: Int8[ndarray, "m"]) -> Float[Tensor, "m 5"]:
    """Symbols that are certain, as scores."""
    return nn.functional.one_hot(torch.from_numpy(symbol.astype(np.int64)), SYMBOLS).float()
