"""The grid graph of a capture: crossings of lines, and which of them are neighbours along a line.

Directions (right, down, left, up) are those of the rectified image, in which the pattern may be turned by any number of
quarter turns.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int32
from numpy import ndarray
from scipy.ndimage import maximum_filter, uniform_filter1d
from scipy.spatial import KDTree

from sl_nerfstudio.geometry.connectivity import component_labels

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

    mask: Float32[ndarray, "h w"]  # probability
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


def phase_maps(
    mask: Float32[ndarray, "h w"], vector: Float32[ndarray, "4 h w"], symbol: Float32[ndarray, "5 h w"]
) -> PhaseMaps:
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
    """Of peaks less than half a period apart, only the highest."""
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
    power = np.exp(at_node - at_node.max(-1, keepdims=True))
    return (power / power.sum(-1, keepdims=True)).astype(np.float32)


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
