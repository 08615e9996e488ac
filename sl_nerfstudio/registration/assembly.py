"""Frames are put together into components, the most certain pairs first.

Two components are joined where one similarity between them is clearly better supported than any other: by all pairs of
frames across the two at once, however few of them were registered. A pair that fits by accident thus joins nothing on
its own once components have grown, and a weak cut between two blocks is judged as a whole. Components whose connection
stays undecided remain apart.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu

from sl_nerfstudio.geometry.lie import Similarities, Similarity, angle_deg, exps_at, logs_at
from sl_nerfstudio.geometry.numerics import geman_mcclure_cost, geman_mcclure_weight
from sl_nerfstudio.registration.evidence import ScanEvidence
from sl_nerfstudio.registration.pairs import (
    LEAST_ODDS,
    SAME_PLACE_DEG,
    SAME_PLACE_SHIFT,
    PairMatch,
    edge_weights,
)

# The pose graph.
KERNEL_CHI2 = 40.0  # chi square (7 degrees of freedom) at which an edge counts a quarter: errors are not quite normal
FIRST_KERNEL_FACTOR = 30.0  # on it to begin with: the drift of a component must be within, wrong pairs beyond
KERNEL_SHRINKAGE = 1.7  # factor by which the squared kernel width falls in an iteration
REJECTION_FACTOR = 4.0  # on KERNEL_CHI2: edges beyond are inconsistent
ITERATIONS = 40  # at most
CONVERGED = 1e-6  # size of a step, radian and radii
LARGEST_LOG_SCALE_STEP = 0.5  # change of the logarithm of a scale in a step
STEP_FACTORS = (1.0, 0.5, 0.25, 0.1, 0.02)  # on a step, until one costs no more than none

# Which components are joined.
MOST_COMPARED = 12  # clearly different similarities
MOST_PAIRS = 10  # of frames across two components that are compared
LEAST_SIGHT_COSINE = float(np.cos(np.radians(75.0)))  # between lines of sight: beyond it frames share no surface

Component = dict[int, Similarity]  # S_world_camera of some frames, in a world of their own

# The pose graph: frames are nodes, similarities between pairs are edges, some of which are wrong. The start is an
# assembled component, so most edges agree with it to within their errors; a Geman-McClure kernel that starts wide and
# narrows (Yang et al., RA-L 2020) keeps the others from doing harm.
#
# Increments (v, w, l) of a node act in its own axes, about a pivot c: `p -> c + exp(l) exp(w) (p - c) + radius v`.


@dataclass(frozen=True)
class Pivots:
    """The point of every frame about which increments rotate and scale, and the length that a radian counts as."""

    centre: Float64[ndarray, "n 3"]  # camera axes, units of the frame's baseline
    radius: Float64[ndarray, "n"]

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.radius)


@dataclass(frozen=True)
class EdgeArrays:
    """Edges one after the other."""

    source: Int64[ndarray, "e"]
    target: Int64[ndarray, "e"]
    S_target_source: Similarities
    information: Float64[ndarray, "e 7 7"]

    @staticmethod
    def of(edges: Sequence[PairMatch]) -> "EdgeArrays":
        """Stack a non-empty sequence."""
        ends = np.array([(e.source, e.target) for e in edges])
        S = Similarities.of([e.S_target_source for e in edges])
        return EdgeArrays(ends[:, 0], ends[:, 1], S, np.stack([e.information for e in edges]))

    def residuals(self, nodes: Similarities, pivots: Pivots) -> Float64[ndarray, "e 7"]:
        """Increments (v, w, l) in the targets' axes, lengths in their radii, by which nodes and edges disagree.

        `nodes` has a similarity for each frame of `pivots`, whichever it is where no edge ends.
        """
        D = nodes.chosen(self.target).inverse() @ nodes.chosen(self.source) @ self.S_target_source.inverse()
        return logs_at(D, pivots.centre[self.target], pivots.radius[self.target])

    def chi_square(self, residuals: Float64[ndarray, "e 7"]) -> Float64[ndarray, "e"]:
        """Squared residuals in units of the edges' covariances."""
        return np.einsum("ei,eij,ej->e", residuals, self.information, residuals)

    def adjoints(self, pivots: Pivots) -> Float64[ndarray, "e 7 7"]:
        """Matrices that turn increments in the sources' axes into those in the targets'."""
        S, radius = self.S_target_source, pivots.radius[self.target]
        lever = (pivots.centre[self.target] - S.points(pivots.centre[self.source])) / radius[:, None]
        A = np.zeros((len(radius), 7, 7))
        A[:, :3, :3] = (S.scale * pivots.radius[self.source] / radius)[:, None, None] * S.R
        A[:, :3, 3:6] = -np.cross(lever[:, None, :], S.R.transpose(0, 2, 1)).transpose(0, 2, 1)  # (R w) x lever
        A[:, :3, 6] = lever
        A[:, 3:6, 3:6] = S.R
        A[:, 6, 6] = 1.0
        return A


@dataclass(frozen=True)
class PoseGraphSolution:
    """One component of frames in its own world."""

    S_world_camera: Component  # in the order of the frames
    consistent: Bool[ndarray, "edges"]  # edges that agree with the solution; False where an end is outside


def optimise_pose_graph(
    edges: Sequence[PairMatch], pivots: Pivots, start: Mapping[int, Similarity], weight: Float64[ndarray, "edges"]
) -> PoseGraphSolution:
    """Optimise all edges inside a component together, robustly, each with its weight.

    The first frame of `start` stays.
    """
    nodes = {k: start[k] for k in sorted(start)}
    inside = np.array([e.source in start and e.target in start for e in edges], dtype=bool)
    connected = [e for e, here in zip(edges, inside, strict=True) if here]
    chi2 = np.full(len(edges), np.inf)
    if connected:
        arrays = EdgeArrays.of(connected)
        every = Similarities.of([nodes.get(k, Similarity.identity()) for k in range(len(pivots))]).orthonormal()
        root = next(iter(start))
        free = np.array([k for k in nodes if k != root], dtype=np.int64)
        every = _optimised(arrays, every, pivots, free, weight[inside])
        chi2[inside] = arrays.chi_square(arrays.residuals(every, pivots))
        each = every.each()
        nodes = {k: each[k] for k in nodes}
    return PoseGraphSolution(nodes, chi2 < REJECTION_FACTOR * KERNEL_CHI2)


def _optimised(
    edges: EdgeArrays, nodes: Similarities, pivots: Pivots, free: Int64[ndarray, "m"], weight: Float64[ndarray, "edges"]
) -> Similarities:
    """Gauss-Newton with a kernel that narrows. Far from a minimum a step may lead away: it is shortened if it costs."""
    adjoints = edges.adjoints(pivots)
    width2 = FIRST_KERNEL_FACTOR * KERNEL_CHI2
    residuals = edges.residuals(nodes, pivots)
    for _ in range(ITERATIONS):
        step, cost = np.zeros((len(pivots), 7)), _cost(edges, residuals, weight, width2)
        if len(free):
            step[free] = _step(edges, adjoints, residuals, weight, width2, free, len(pivots))
        for factor in STEP_FACTORS:
            moved = nodes @ exps_at(factor * step, pivots.centre, pivots.radius, LARGEST_LOG_SCALE_STEP)
            there = edges.residuals(moved, pivots)
            if _cost(edges, there, weight, width2) <= cost:
                nodes, residuals = moved, there
                break
        if width2 <= KERNEL_CHI2 and np.abs(step).max() < CONVERGED:
            break
        width2 = max(KERNEL_CHI2, width2 / KERNEL_SHRINKAGE)
    return nodes


def _cost(
    edges: EdgeArrays, residuals: Float64[ndarray, "edges 7"], weight: Float64[ndarray, "edges"], width2: float
) -> float:
    """What all edges cost with a kernel of a squared width."""
    return float(weight @ geman_mcclure_cost(edges.chi_square(residuals) / width2))


def _step(
    edges: EdgeArrays,
    adjoints: Float64[ndarray, "edges 7 7"],
    residuals: Float64[ndarray, "edges 7"],
    weight: Float64[ndarray, "edges"],
    width2: float,
    free: Int64[ndarray, "m"],
    frames: int,
) -> Float64[ndarray, "m 7"]:
    """Increments of the free nodes. The matrix is sparse: a frame is linked with few others."""
    kernel = geman_mcclure_weight(edges.chi_square(residuals) / width2)
    W = (weight * kernel)[:, None, None] * edges.information
    by_source = adjoints.transpose(0, 2, 1) @ W  # the derivative by the target's increment is minus one
    blocks = [(edges.source, edges.source, by_source @ adjoints), (edges.source, edges.target, -by_source),
              (edges.target, edges.source, -by_source.transpose(0, 2, 1)), (edges.target, edges.target, W)]  # fmt: skip
    g, column = np.zeros((frames, 7)), np.full(frames, -1)
    np.add.at(g, edges.source, (by_source @ residuals[..., None])[..., 0])
    np.add.at(g, edges.target, -(W @ residuals[..., None])[..., 0])
    column[free] = np.arange(len(free))
    size, each = 7 * len(free), np.arange(7)
    rows, columns, values = [np.arange(size)], [np.arange(size)], [np.full(size, 1e-9)]
    for a, b, block in blocks:
        moves = (column[a] >= 0) & (column[b] >= 0)
        i, j = (7 * column[k[moves], None, None] for k in (a, b))
        rows.append(np.broadcast_to(i + each[:, None], (len(i), 7, 7)).ravel())
        columns.append(np.broadcast_to(j + each, (len(i), 7, 7)).ravel())
        values.append(block[moves].ravel())
    H = coo_array((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), (size, size)).tocsc()
    factor = splu(H, permc_spec="MMD_AT_PLUS_A")
    return -factor.solve(g[free].ravel()).reshape(-1, 7)


# Assembly.


@dataclass(frozen=True)
class Link:
    """A similarity between two components that a pair across says."""

    S_first_second: Similarity
    log_odds: float  # of the pair's place against nothing
    edge: PairMatch


Prior = Callable[[int, int, Similarity], float]


class Assembly:
    """Components of frames, grown along registered pairs.

    Two components are joined at the place at which all frames across them that face each other there, registered or
    not, are together most likely to belong; if that leads all others by enough.
    """

    def __init__(
        self, scan: ScanEvidence, pivots: Pivots, edges: Sequence[PairMatch], prior: Prior | None = None,
        slipping: bool = False,
    ) -> None:  # fmt: skip
        """Start with every frame as a component of its own.

        Args:
            scan: compares frames.
            pivots: of every frame, for the pose graph.
            edges: pairs that say where components may belong.
            prior: log-odds, in nats, of the place of a frame on another by the order of capture.
            slipping: components are joined though they may slip along each other.
        """
        self._scan, self._pivots, self._prior, self._slipping = scan, pivots, prior, slipping
        self._edges = sorted(edges, key=lambda e: -e.lead)
        self._weight = edge_weights(self._edges)
        self._rejected: set[tuple[int, int]] = set()  # of the numbers of two components
        self.components: list[Component] = [{k: Similarity.identity()} for k in range(len(pivots))]
        self._number = list(range(len(pivots)))  # of each frame's component
        self._joins = 0
        self.by_order = False  # the order of capture has decided a place that surfaces did not

    def grow(self) -> list[Component]:
        """Join components until no connection is decided; the largest first."""
        while self._join_next():
            pass
        return sorted(self.components, key=lambda c: (-len(c), min(c)))

    def _join_next(self) -> bool:
        for edge in self._edges:
            a, b = self._number[edge.target], self._number[edge.source]
            if a == b or (key := (min(a, b), max(a, b))) in self._rejected:
                continue
            first, second = self._component_of(edge.target), self._component_of(edge.source)
            S = self.decide(first, second)
            if S is None:
                self._rejected.add(key)
                continue
            self.components = [c for c in self.components if c is not first and c is not second]
            self.components.append(self._joined(first, second, S))
            self._joins += 1
            for k in self.components[-1]:
                self._number[k] = len(self._pivots) - 1 + self._joins
            return True
        return False

    def _component_of(self, frame: int) -> Component:
        return next(c for c in self.components if frame in c)

    def _joined(self, first: Component, second: Component, S: Similarity) -> Component:
        """Merge both in the world of the first, with all pairs inside optimised together."""
        both = {**first, **{k: S @ S_second for k, S_second in second.items()}}
        found = optimise_pose_graph(self._edges, self._pivots, both, self._weight).S_world_camera
        return {k: found[k] for k in both}

    def decide(self, first: Component, second: Component) -> Similarity | None:
        """The similarity between two components; None where it is not certain."""
        places = self._proposed(first, second)
        if not places:
            return None
        leads, odds = self.compare(first, second, places)
        usual = np.array([self._usual(first, second, S) for S in places])
        both = leads + usual[:, None] - usual
        best = int(np.argmax(both.min(1)))
        if odds[best] < LEAST_ODDS:
            return None
        others = [k for k in range(len(places)) if k != best]
        if others and both[best, others].min() < LEAST_ODDS and not self._slipping:
            return None
        self.by_order |= bool(others) and bool(leads[best, others].min() < LEAST_ODDS)
        return places[best]

    def _proposed(self, first: Component, second: Component) -> list[Similarity]:
        """The clearly different similarities between two components that pairs across say, the most likely first."""
        links = [link for e in self._between(first, second) for link in self._links(e, first, second)]
        distinct: list[Similarity] = []
        for link in sorted(links, key=lambda one: -one.log_odds):
            if len(distinct) == MOST_COMPARED:
                break
            if all(self.differ(link.S_first_second, other, second) for other in distinct):
                distinct.append(link.S_first_second)
        return distinct

    def compare(
        self, first: Component, second: Component, places: Sequence[Similarity]
    ) -> tuple[Float64[ndarray, "k k"], Float64[ndarray, "k"]]:
        """By how many nats each place leads each other, and anywhere else: sums over all frames that face each other."""
        leads, odds = np.zeros((len(places), len(places))), np.zeros(len(places))
        near = [set(facing(first, second, S)) for S in places]
        for i, j in sorted(set().union(*near)):
            here = [
                first[i].inverse() @ S @ second[j] if (i, j) in pairs else None
                for S, pairs in zip(places, near, strict=True)
            ]
            each = self._scan.comparison(j, i, here)
            leads, odds = leads + each[0], odds + each[1]
        return leads, odds

    def _usual(self, first: Component, second: Component, S: Similarity) -> float:
        """Log-odds of a place by the order of capture."""
        if self._prior is None:
            return 0.0
        return sum(self._prior(i, j, first[i].inverse() @ S @ second[j]) for i in first for j in second)

    def _between(self, first: Component, second: Component) -> list[PairMatch]:
        return [
            e
            for e in self._edges
            if (e.source in first and e.target in second) or (e.source in second and e.target in first)
        ]

    @staticmethod
    def _links(e: PairMatch, first: Component, second: Component) -> list[Link]:
        """What a pair across says: its best similarity and its rivals."""
        forward = e.source in second
        target, source = (e.target, e.source) if forward else (e.source, e.target)
        places = [(e.S_target_source, e.log_odds)]
        places += [(r.S_target_source, e.log_odds + r.log_odds) for r in e.rivals]
        return [
            Link(first[target] @ (S if forward else S.inverse()) @ second[source].inverse(), odds, e)
            for S, odds in places
        ]

    def differ(self, a: Similarity, b: Similarity, second: Component) -> bool:
        """Whether two similarities put the frames of `second` at clearly different places."""
        if angle_deg(a.R @ b.R.T) > SAME_PLACE_DEG:
            return True
        shifts = []
        for k, S in second.items():
            p, radius = S.points(self._pivots.centre[k][None]), a.scale * S.scale * self._pivots.radius[k]
            shifts.append(float(np.linalg.norm(a.points(p) - b.points(p))) / radius)
        return min(shifts) > SAME_PLACE_SHIFT


def facing(first: Component, second: Component, S: Similarity, most: int = MOST_PAIRS) -> list[tuple[int, int]]:
    """The pairs of frames across two components whose cameras look most nearly the same way."""
    here, there = list(first), list(second)
    if not here or not there:
        return []
    sight = np.array([first[i].R[:, 2] for i in here]), np.array([(S.R @ second[j].R)[:, 2] for j in there])
    cosine = (sight[0][:, None] * sight[1]).sum(-1).ravel()
    near = np.argsort(-cosine, kind="stable")[:most]
    return [(here[k // len(there)], there[k % len(there)]) for k in near if cosine[k] > LEAST_SIGHT_COSINE]


def _cosine(a: Similarity, b: Similarity) -> float:
    """Cosine of the angle between the lines of sight of two cameras."""
    return float(a.R[:, 2] @ b.R[:, 2])


def see_same_side(a: Similarity, b: Similarity) -> bool:
    """Whether the lines of sight of two cameras differ little enough to see a common surface."""
    return _cosine(a, b) > LEAST_SIGHT_COSINE
