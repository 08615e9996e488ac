"""Pose graph optimisation: frames are nodes, similarities between pairs are edges, some of which are wrong.

The start is an assembled component, so most edges agree with it to within their errors. A Geman-McClure kernel that
starts wide and narrows (Yang et al., RA-L 2020) keeps the others from doing harm.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu

from sl_nerfstudio.geometry.robust import geman_mcclure_cost, geman_mcclure_weight
from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.graph_residuals import EdgeArrays, Nodes, Pivots
from sl_nerfstudio.registration.pairs.pair_match import PairMatch
from sl_nerfstudio.registration.settings import REGISTRATION_DEFAULTS, PoseGraphSettings
from sl_nerfstudio.registration.similarities import Similarities, exps_at


@dataclass(frozen=True)
class PoseGraphSolution:
    """One component of frames in its own world."""

    S_world_camera: Nodes  # None for frames outside
    consistent: Bool[ndarray, "edges"]  # edges that agree with the solution; False where an end is outside


def optimise_pose_graph(
    edges: Sequence[PairMatch],
    pivots: Pivots,
    start: Mapping[int, Similarity],
    weight: Float64[ndarray, "edges"],
    settings: PoseGraphSettings = REGISTRATION_DEFAULTS.pose_graph,
) -> PoseGraphSolution:
    """All edges inside a component together, robustly, each with its weight. The first frame of `start` stays."""
    nodes: Nodes = [start.get(k) for k in range(len(pivots))]
    inside = np.array([e.source in start and e.target in start for e in edges], dtype=bool)
    connected = [e for e, here in zip(edges, inside, strict=True) if here]
    chi2 = np.full(len(edges), np.inf)
    if connected:
        arrays = EdgeArrays.of(connected)
        every = Similarities.of([S or Similarity.identity() for S in nodes]).orthonormal()
        root = next(iter(start))
        free = np.array([k for k, S in enumerate(nodes) if S is not None and k != root], dtype=np.int64)
        every = _optimised(arrays, every, pivots, free, weight[inside], settings)
        chi2[inside] = arrays.chi_square(arrays.residuals(every, pivots))
        nodes = [None if S is None else found for S, found in zip(nodes, every.each(), strict=True)]
    return PoseGraphSolution(nodes, chi2 < settings.rejection_factor * settings.kernel_chi2)


def _optimised(
    edges: EdgeArrays,
    nodes: Similarities,
    pivots: Pivots,
    free: Int64[ndarray, "m"],
    weight: Float64[ndarray, "edges"],
    settings: PoseGraphSettings,
) -> Similarities:
    """Gauss-Newton with a kernel that narrows. Far from a minimum a step may lead away: it is shortened if it costs."""
    adjoints = edges.adjoints(pivots)
    width2 = settings.first_kernel_factor * settings.kernel_chi2
    residuals = edges.residuals(nodes, pivots)
    for _ in range(settings.iterations):
        step, cost = np.zeros((len(pivots), 7)), _cost(edges, residuals, weight, width2)
        if len(free):
            step[free] = _step(edges, adjoints, residuals, weight, width2, free, len(pivots), settings)
        for factor in settings.step_factors:
            moved = nodes @ exps_at(factor * step, pivots.centre, pivots.radius, settings.largest_log_scale_step)
            there = edges.residuals(moved, pivots)
            if _cost(edges, there, weight, width2) <= cost:
                nodes, residuals = moved, there
                break
        if width2 <= settings.kernel_chi2 and np.abs(step).max() < settings.converged:
            break
        width2 = max(settings.kernel_chi2, width2 / settings.kernel_shrinkage)
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
    settings: PoseGraphSettings,
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
    rows, columns, values = [np.arange(size)], [np.arange(size)], [np.full(size, settings.least_information)]
    for a, b, block in blocks:
        moves = (column[a] >= 0) & (column[b] >= 0)
        i, j = (7 * column[k[moves], None, None] for k in (a, b))
        rows.append(np.broadcast_to(i + each[:, None], (len(i), 7, 7)).ravel())
        columns.append(np.broadcast_to(j + each, (len(i), 7, 7)).ravel())
        values.append(block[moves].ravel())
    H = coo_array((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), (size, size)).tocsc()
    factor = splu(H, permc_spec="MMD_AT_PLUS_A")
    return -factor.solve(g[free].ravel()).reshape(-1, 7)
