"""Frames are put together into components, the most certain pairs first.

Two components are joined where one similarity between them is clearly better supported than any other: by all pairs of
frames across the two at once, however few of them were registered. A pair that fits by accident thus joins nothing on
its own once components have grown, and a weak cut between two blocks is judged as a whole. Components whose connection
stays undecided remain apart.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu

from sl_nerfstudio.geometry.lie import Similarities, Similarity, angle_deg, exps_at, log_at, logs_at
from sl_nerfstudio.geometry.numerics import geman_mcclure_cost, geman_mcclure_weight
from sl_nerfstudio.registration.agreement import Agreement, Hypotheses, Side, Tolerance, agreement
from sl_nerfstudio.registration.pairs import (
    GOOD_QUANTILE,
    SLIP_RISE,
    PairMatch,
    edge_weights,
    motion_cost,
    quality,
    rise_of,
    screw_motion,
    support,
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
CROSS_SIGMAS = 6.0  # of two surfaces within which points agree: components have small errors of their own
LEAST_AGREEING = 0.15  # points that must agree across two components, in frames: 1 is all points of one frame
MISFIT_FACTOR = 2.5  # on the share of points that contradict in good pairs of the scan: what a connection may have
INNER_MISFIT_FACTOR = 1.6  # the same, relative to frames of one component that look as much alike
LEAST_MISFIT = 0.015  # share that may contradict in good pairs: points at edges do in every pair
LARGEST_SIGMA_DEG = 6.0  # of the least known rotation of a pair that joins two components on its own
LARGEST_RIVAL = 0.85  # votes for another similarity, relative to the best, from which the connection is undecided
SLIP_DEG = 8.0  # rotation along which two components must notice that they slip
SLIP_WIDTHS = (0.4, 0.8, 1.6, 3.2)  # of the kernel of that test, in sigmas of the surfaces: the first wide enough
SATURATED = 0.4  # mean cost from which a kernel is too narrow for the errors that components have of their own
SAME_CHI2 = 30.0  # of the difference between two similarities (7 degrees of freedom) up to which they are one
MOST_COMPARED = 8  # clearly different similarities
SAME_SIDE_DEG = 8.0  # rotation between two similarities below which they are one
SAME_SIDE_SHIFT = 0.2  # shift between two similarities, radii, below which they are one
MOST_PAIRS = 12  # of frames across two components that are compared
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
    quality: float
    edge: PairMatch
    best: bool  # of the pair: False for a rival


@dataclass(frozen=True)
class Joint:
    """Agreement of two components under one similarity: sums over pairs of frames across them."""

    S_first_second: Similarity
    votes: float  # of registered pairs: their quality, where it is their best result, or a share of it
    links: int  # registered pairs of which it is the best result
    agreeing: float  # points, in frames: 1 is all points of one frame
    contradicting: float

    @property
    def fitness(self) -> float:
        """Share of the points that could be judged which agrees."""
        return self.agreeing / max(self.agreeing + self.contradicting, 1e-9)


class Assembly:
    """Components of frames, grown along registered pairs."""

    def __init__(
        self,
        sides: Sequence[Side],
        pivots: Pivots,
        edges: Sequence[PairMatch],
        slipping: Sequence[PairMatch] = (),
        fitness: Sequence[float] | None = None,
        misfit_factor: float = MISFIT_FACTOR,
    ) -> None:
        """Start with every frame as a component of its own.

        Args:
            sides: points of every frame.
            pivots: of every frame, for the pose graph.
            edges: pairs that may join components.
            slipping: pairs that may slip. They only say along which motions two components must be held in place.
            fitness: of the pairs by which a good one is judged; None: of all edges.
            misfit_factor: see MISFIT_FACTOR.
        """
        self._slipping = slipping
        self._sides = sides
        self._pivots = pivots
        self._edges = sorted(edges, key=lambda e: -quality(e))
        self._weight = edge_weights(self._edges)
        self._rejected: set[tuple[int, int]] = set()  # of the numbers of two components
        fitness = [e.fitness for e in edges] if fitness is None else fitness
        usual = float(np.quantile(fitness, GOOD_QUANTILE)) if len(fitness) else 1.0
        self._largest_misfit = misfit_factor * max(LEAST_MISFIT, 1 - usual)
        self.components: list[Component] = [{k: Similarity.identity()} for k in range(len(sides))]
        self._number = list(range(len(sides)))  # of each frame's component
        self._joins = 0

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
            joint = self.decide(first, second)
            if joint is None:
                self._rejected.add(key)
                continue
            self.components = [c for c in self.components if c is not first and c is not second]
            self.components.append(self._joined(first, second, joint.S_first_second))
            self._joins += 1
            for k in self.components[-1]:
                self._number[k] = len(self._sides) - 1 + self._joins
            return True
        return False

    def _component_of(self, frame: int) -> Component:
        return next(c for c in self.components if frame in c)

    def _joined(self, first: Component, second: Component, S: Similarity) -> Component:
        """Merge both in the world of the first, with all pairs inside optimised together."""
        both = {**first, **{k: S @ S_second for k, S_second in second.items()}}
        found = optimise_pose_graph(self._edges, self._pivots, both, self._weight).S_world_camera
        return {k: found[k] for k in both}

    def decide(self, first: Component, second: Component) -> Joint | None:
        """The similarity between two components; None where it is not certain."""
        found = [(self._score(j, first, second), j) for j in self._joints(first, second)]
        if not found:
            return None
        (score, best), *others = sorted(found, key=lambda scored: -scored[0])
        if best.agreeing < LEAST_AGREEING or score <= 0:
            return None
        if others and others[0][0] > LARGEST_RIVAL * score:
            return None
        if not self._held_by_tone(best, first, second) and any(
            self._slips(best, e, first, second) for e in self._between(self._slipping, first, second)
        ):
            return None
        if best.links < 2 and not self._certain_alone(first, second):
            return None
        return best

    def _score(self, joint: Joint, first: Component, second: Component) -> float:
        """Votes, less where points contradict; nothing where more do than in good pairs and inside the components."""
        S = joint.S_first_second
        cosines = [_cosine(first[i], S @ second[j]) for i, j in self._facing(first, second, S)]
        inner = max(self._inner_misfit(one, cosines) for one in (first, second))
        largest = max(self._largest_misfit, INNER_MISFIT_FACTOR * inner)
        return joint.votes * max(0.0, 1 - (1 - joint.fitness) / largest)

    def _inner_misfit(self, component: Component, cosines: Sequence[float]) -> float:
        """Share of the points that contradict between frames of one component; 0 if there is no such pair.

        For each pair of frames across two components, of which `cosines` has the cosine between the lines of sight,
        one pair inside is judged that looks about as much alike: frames that are farther apart share less surface, and
        more of it lies at edges.
        """
        frames = sorted(component)
        i, j = np.triu_indices(len(frames), 1)
        sight = np.array([component[k].R[:, 2] for k in frames])
        inside = (sight[i] * sight[j]).sum(1)
        if not len(cosines) or not (inside > LEAST_SIGHT_COSINE).any():
            return 0.0
        nearest = {int(np.abs(inside - cosine).argmin()) for cosine in cosines}
        alike = [(frames[i[k]], frames[j[k]]) for k in nearest]
        agreeing, contradicting = self._totals(
            self._agreement(i, j, component[i].inverse() @ component[j]) for i, j in alike
        )
        return contradicting / max(agreeing + contradicting, 1e-9)

    def _joints(self, first: Component, second: Component) -> list[Joint]:
        """The clearly different similarities between two components that pairs across say, with their votes."""
        links = [self._links(e, first, second) for e in self._between(self._edges, first, second)]
        distinct: list[Link] = []
        for link in sorted((one for of_pair in links for one in of_pair), key=lambda one: -one.quality):
            if not any(self._same(link, other.S_first_second, first, second) for other in distinct):
                distinct.append(link)
        return [self._judge(first, second, one.S_first_second, links) for one in distinct[:MOST_COMPARED]]

    @staticmethod
    def _between(edges: Sequence[PairMatch], first: Component, second: Component) -> list[PairMatch]:
        return [
            e for e in edges if (e.source in first and e.target in second) or (e.source in second and e.target in first)
        ]

    def _links(self, e: PairMatch, first: Component, second: Component) -> list[Link]:
        """What a pair across says: its best similarity and its rivals, each with its quality."""
        forward = e.source in second
        target, source = (e.target, e.source) if forward else (e.source, e.target)
        best = support(e)
        results = [(e.S_target_source, best), *((r.S_target_source, best * r.ratio) for r in e.rivals)]
        return [
            Link(first[target] @ (S if forward else S.inverse()) @ second[source].inverse(), q, e, k == 0)
            for k, (S, q) in enumerate(results)
        ]

    def _same(self, link: Link, S: Similarity, first: Component, second: Component) -> bool:
        """Whether a similarity is that of a link, to within the uncertainty of its pair."""
        if not self._differ(S, link.S_first_second, second):
            return True
        if not link.best:
            return False
        e = link.edge
        T = S if e.source in second else S.inverse()
        own, other = (first, second) if e.source in second else (second, first)
        D = own[e.target].inverse() @ T @ other[e.source] @ e.S_target_source.inverse()
        x = log_at(D, self._pivots.centre[e.target], self._pivots.radius[e.target])
        return bool(x @ e.information @ x < SAME_CHI2)

    def _judge(self, first: Component, second: Component, S: Similarity, links: Sequence[Sequence[Link]]) -> Joint:
        """Votes of the pairs across, and the points of all frames across that see the same side."""
        votes, same = 0.0, 0
        for of_pair in links:
            near = [link for link in of_pair if self._same(link, S, first, second)]
            votes += max((link.quality for link in near), default=0.0)
            same += any(link.best for link in near)
        across = self._agreements(first, second, S)
        return Joint(S, votes, same, *self._totals(across))

    def _agreements(
        self, first: Component, second: Component, S: Similarity, sigmas: float = CROSS_SIGMAS
    ) -> Iterator[Agreement]:
        """Each pair of frames across that see the same side, within some standard deviations of their surfaces."""
        for i, j in self._facing(first, second, S):
            yield self._agreement(i, j, first[i].inverse() @ S @ second[j], sigmas)

    def _agreement(self, i: int, j: int, S_i_j: Similarity, sigmas: float = CROSS_SIGMAS) -> Agreement:
        return agreement(self._sides[j], self._sides[i], Hypotheses.of(S_i_j), Tolerance(0.0, sigmas))

    def _totals(self, pairs: Iterable[Agreement]) -> tuple[float, float]:
        """Points that agree, and those that contradict, of all pairs."""
        agreeing = contradicting = 0.0
        for sums in pairs:
            agreeing += float(sums.agreeing[0])
            contradicting += float(sums.contradicting[0])
        return agreeing, contradicting

    def _held_by_tone(self, joint: Joint, first: Component, second: Component) -> bool:
        """Whether brightness constrains what geometry leaves free: a pair across that tones hold says the same."""
        return any(
            self._same(self._links(e, first, second)[0], joint.S_first_second, first, second)
            for e in self._between(self._edges, first, second)
            if e.by_tone
        )

    def _slips(self, joint: Joint, e: PairMatch, first: Component, second: Component) -> bool:
        """Whether all frames across together do not notice the motion along which one pair of them slips."""
        if not self._same(self._links(e, first, second)[0], joint.S_first_second, first, second):
            return False  # the pair says something else
        for sigmas in SLIP_WIDTHS:
            still = self._misfit_cost(first, second, joint.S_first_second, sigmas)
            if still < SATURATED:
                break
        own = first if e.target in first else second
        surface, to_camera = self._sides[e.target].map, own[e.target].inverse()
        rises = []
        for sense in (1.0, -1.0):
            M = screw_motion(sense * np.radians(SLIP_DEG) * e.slip_direction, surface)
            M = own[e.target] @ M @ to_camera
            S = M @ joint.S_first_second if own is first else joint.S_first_second @ M
            rises.append(self._rise(first, second, joint.S_first_second, S, sigmas))
        return min(rises) < SLIP_RISE

    def _rise(self, first: Component, second: Component, still: Similarity, moved: Similarity, sigmas: float) -> float:
        """Rise of the cost by a motion of one component against the other, all pairs of frames across together."""
        costs = np.zeros((2, 4))
        for i, j in self._facing(first, second, still):
            before, after = (first[i].inverse() @ S @ second[j] for S in (still, moved))
            costs += motion_cost((self._sides[j], self._sides[i]), before, after, Tolerance(0.0, sigmas))
        return rise_of(costs)

    def _misfit_cost(self, first: Component, second: Component, S: Similarity, sigmas: float) -> float:
        """Mean robust cost over the pairs of frames across, by the points that each can judge; 1 without any."""
        costs, weights = [1.0], [1e-9]
        for sums in self._agreements(first, second, S, sigmas):
            costs.append(float(sums.cost[0]))
            weights.append(float(sums.judged[0]))
        return float(np.average(costs, weights=weights))

    def _certain_alone(self, first: Component, second: Component) -> bool:
        """Whether one of the pairs across determines the similarity by itself."""
        return any(
            e.slip_deg == 0
            and e.rotation_sigma_deg < LARGEST_SIGMA_DEG
            and e.second_best_ratio < LARGEST_RIVAL
            and 1 - e.fitness < self._largest_misfit
            for e in self._between(self._edges, first, second)
        )

    def _facing(self, first: Component, second: Component, S: Similarity) -> list[tuple[int, int]]:
        """The pairs across whose cameras look most nearly the same way."""
        here, there = list(first), list(second)
        sight = np.array([first[i].R[:, 2] for i in here]), np.array([(S.R @ second[j].R)[:, 2] for j in there])
        cosine = (sight[0][:, None] * sight[1]).sum(-1).ravel()
        near = np.argsort(-cosine, kind="stable")[:MOST_PAIRS]
        return [(here[k // len(there)], there[k % len(there)]) for k in near if cosine[k] > LEAST_SIGHT_COSINE]

    def _differ(self, a: Similarity, b: Similarity, second: Component) -> bool:
        """Whether two similarities put the frames of `second` at clearly different places."""
        if angle_deg(a.R @ b.R.T) > SAME_SIDE_DEG:
            return True
        shifts = []
        for k, S in second.items():
            surface = self._sides[k].map
            p, radius = S.points(surface.centroid[None]), a.scale * S.scale * surface.radius
            shifts.append(float(np.linalg.norm(a.points(p) - b.points(p))) / radius)
        return min(shifts) > SAME_SIDE_SHIFT


def _cosine(a: Similarity, b: Similarity) -> float:
    """Cosine of the angle between the lines of sight of two cameras."""
    return float(a.R[:, 2] @ b.R[:, 2])


def see_same_side(a: Similarity, b: Similarity) -> bool:
    """Whether the lines of sight of two cameras differ little enough to see a common surface."""
    return _cosine(a, b) > LEAST_SIGHT_COSINE
