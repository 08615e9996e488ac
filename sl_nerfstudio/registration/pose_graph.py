"""Pose graph: frames are nodes, similarities between pairs are edges, some of which are wrong.

The start is an assembled component, so most edges agree with it to within their errors; a Geman-McClure kernel that
starts wide and narrows (Yang et al., RA-L 2020) keeps the others from doing harm.

Increments (v, w, l) of a node act in its own axes, about a pivot c: `p -> c + exp(l) exp(w) (p - c) + radius v`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu

from sl_nerfstudio.geometry.lie import Similarities, Similarity, exps_at, logs_at
from sl_nerfstudio.geometry.numerics import geman_mcclure_cost, geman_mcclure_weight
from sl_nerfstudio.registration.pairs import PairMatch, edge_weights

KERNEL_CHI2 = 40.0  # chi square (7 degrees of freedom) at which an edge counts a quarter: errors are not quite normal
FIRST_KERNEL_FACTOR = 30.0  # on it to begin with: the drift of a component must be within, wrong pairs beyond
KERNEL_SHRINKAGE = 1.7  # factor by which the squared kernel width falls in an iteration
REJECTION_FACTOR = 4.0  # on KERNEL_CHI2: edges beyond are inconsistent
ITERATIONS = 40  # at most
CONVERGED = 1e-6  # size of a step, radian and radii
LARGEST_LOG_SCALE_STEP = 0.5  # change of the logarithm of a scale in a step
STEP_FACTORS = (1.0, 0.5, 0.25, 0.1, 0.02)  # on a step, until one costs no more than none

Component = dict[int, Similarity]  # S_world_camera of some frames, in a world of their own


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

    def covariance_of(self, frame: int, pivots: Pivots) -> Float64[ndarray, "7 7"]:
        """The covariance of one frame's increment in its own axes, at one end of all edges, the other ends held."""
        A = np.where((self.source == frame)[:, None, None], self.adjoints(pivots), np.eye(7))
        return np.linalg.inv((A.transpose(0, 2, 1) @ self.information @ A).sum(0))


def at_places(edges: Sequence[PairMatch], nodes: Mapping[int, Similarity]) -> list[PairMatch]:
    """The pairs, each at that of its places which is nearest to where its frames are."""
    out: list[PairMatch] = []
    for e in edges:
        if e.rivals and e.source in nodes and e.target in nodes:
            nearest = e.nearest(nodes[e.target].inverse() @ nodes[e.source])
            out.append(e if nearest is e.S_target_source else replace(e, S_target_source=nearest))
        else:
            out.append(e)
    return out


@dataclass(frozen=True)
class PoseGraphSolution:
    """One component of frames in its own world."""

    S_world_camera: Component  # in the order of the frames
    consistent: Bool[ndarray, "edges"]  # edges that agree with the solution; False where an end is outside


def optimise_pose_graph(
    edges: Sequence[PairMatch], pivots: Pivots, start: Mapping[int, Similarity], weight: Float64[ndarray, "edges"],
    free: Sequence[int] | None = None,
) -> PoseGraphSolution:  # fmt: skip
    """Optimise all edges inside a component together, robustly, each with its weight.

    `free`: the frames that may move; None: all but the first of `start`.
    """
    nodes = {k: start[k] for k in sorted(start)}
    inside = np.array([e.source in start and e.target in start for e in edges], dtype=bool)
    connected = [e for e, here in zip(edges, inside, strict=True) if here]
    chi2 = np.full(len(edges), np.inf)
    if connected:
        arrays = EdgeArrays.of(connected)
        every = Similarities.of([nodes.get(k, Similarity.identity()) for k in range(len(pivots))]).orthonormal()
        root = next(iter(start))
        moving = np.array([k for k in nodes if k != root] if free is None else free, dtype=np.int64)
        every = _optimised(arrays, every, pivots, moving, weight[inside])
        chi2[inside] = arrays.chi_square(arrays.residuals(every, pivots))
        each = every.each()
        nodes = {k: each[k] for k in nodes}
    return PoseGraphSolution(nodes, chi2 < REJECTION_FACTOR * KERNEL_CHI2)


def optimise_at_places(
    edges: Sequence[PairMatch], pivots: Pivots, start: Mapping[int, Similarity], free: Sequence[int] | None = None
) -> PoseGraphSolution:
    """Optimise all edges inside a component together, each at its place nearest to where its frames are."""
    return optimise_pose_graph(at_places(edges, start), pivots, start, edge_weights(edges), free)


def optimise_known(edges: Sequence[PairMatch], pivots: Pivots, start: Mapping[int, Similarity]) -> PoseGraphSolution:
    """The same with frames that are about where they belong: pairs that do not know that place have no say."""
    weight = edge_weights(edges) * np.array([e.knows(start) for e in edges], dtype=np.float64)
    return optimise_pose_graph(at_places(edges, start), pivots, start, weight)


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
        taken = False
        for factor in STEP_FACTORS:
            moved = nodes @ exps_at(factor * step, pivots.centre, pivots.radius, LARGEST_LOG_SCALE_STEP)
            there = edges.residuals(moved, pivots)
            if _cost(edges, there, weight, width2) <= cost:
                nodes, residuals, taken = moved, there, True
                break
        if width2 <= KERNEL_CHI2 and (not taken or np.abs(step).max() < CONVERGED):
            break  # without a step that costs less, the next one would be the same
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
