"""Pose graph optimisation: frames are nodes, similarities between pairs are edges, some of which are wrong.

The start is an assembled component, so most edges agree with it to within their errors. A Geman-McClure kernel that
starts wide and narrows (Yang et al., RA-L 2020) keeps the others from doing harm.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from sl_nerfstudio.geometry.robust import geman_mcclure_weight
from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.graph_residuals import Nodes, Pivots, adjoint, chi_square, node_at, residual
from sl_nerfstudio.registration.increments import exp_at
from sl_nerfstudio.registration.pairs.pair_match import PairMatch
from sl_nerfstudio.registration.settings import REGISTRATION_DEFAULTS, PoseGraphSettings


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
        nodes = _optimised(connected, nodes, pivots, next(iter(start)), weight[inside], settings)
        chi2[inside] = chi_square(connected, nodes, pivots)
    return PoseGraphSolution(nodes, chi2 < settings.rejection_factor * settings.kernel_chi2)


def _optimised(
    edges: Sequence[PairMatch],
    nodes: Nodes,
    pivots: Pivots,
    root: int,
    weight: Float64[ndarray, "edges"],
    settings: PoseGraphSettings,
) -> Nodes:
    """Gauss-Newton with a kernel that narrows."""
    free = [k for k, S in enumerate(nodes) if S is not None and k != root]
    column = {k: 7 * c for c, k in enumerate(free)}
    width2 = settings.first_kernel_factor * settings.kernel_chi2
    for _ in range(settings.iterations):
        H, g = _normal_equations(edges, nodes, pivots, weight, width2, column)
        step = -np.linalg.solve(H, g) if free else np.zeros(0)
        moved = list(nodes)
        for k, c in column.items():
            increment = exp_at(step[c : c + 7], pivots.centre[k], pivots.radius[k], settings.largest_log_scale_step)
            moved[k] = node_at(nodes, k) @ increment
        nodes = moved
        if width2 <= settings.kernel_chi2 and (not free or np.abs(step).max() < settings.converged):
            break
        width2 = max(settings.kernel_chi2, width2 / settings.kernel_shrinkage)
    return nodes


def _normal_equations(
    edges: Sequence[PairMatch],
    nodes: Nodes,
    pivots: Pivots,
    weight: Float64[ndarray, "edges"],
    width2: float,
    column: dict[int, int],
) -> tuple[Float64[ndarray, "m m"], Float64[ndarray, "m"]]:
    """`column`: where the seven unknowns of each free node begin."""
    size = 7 * len(column)
    H, g = 1e-9 * np.eye(size), np.zeros(size)
    for edge, own in zip(edges, weight, strict=True):
        x = residual(edge, nodes, pivots)
        W = own * edge.information * geman_mcclure_weight(x @ edge.information @ x / width2)
        parts = [(edge.source, adjoint(edge, pivots)), (edge.target, -np.eye(7))]
        blocks = [(slice(column[k], column[k] + 7), J) for k, J in parts if k in column]
        for rows, J_a in blocks:
            g[rows] += J_a.T @ (W @ x)
            for columns, J_b in blocks:
                H[rows, columns] += J_a.T @ W @ J_b
    return H, g
