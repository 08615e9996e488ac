"""Pose graph optimisation: frames are nodes, similarities between pairs are edges, some of which are wrong.

Wrong edges are kept from doing harm in two ways: the optimisation starts from the spanning tree with which most other
edges agree, and its Geman-McClure kernel starts wide and narrows (Yang et al., RA-L 2020).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from sl_nerfstudio.geometry.robust import geman_mcclure_weight
from sl_nerfstudio.registration.graph_residuals import Nodes, Pivots, adjoint, chi_square, exp_at, node_at, residual
from sl_nerfstudio.registration.pair_match import PairMatch
from sl_nerfstudio.registration.settings import REGISTRATION_DEFAULTS, PoseGraphSettings
from sl_nerfstudio.registration.spanning_tree import best_tree


@dataclass(frozen=True)
class PoseGraphSolution:
    """`S_world_camera` of every frame, None for frames that no edge connects to the root."""

    S_world_camera: Nodes
    consistent: Bool[ndarray, "edges"]  # edges that agree with the solution


def optimise_pose_graph(
    edges: Sequence[PairMatch],
    pivots: Pivots,
    root: int,
    strength: Float64[ndarray, "edges"],
    weight: Float64[ndarray, "edges"],
    settings: PoseGraphSettings = REGISTRATION_DEFAULTS.pose_graph,
) -> PoseGraphSolution:
    """The spanning tree from `root` that most edges agree with, then all edges together, robustly.

    `strength` is what a tree prefers, `weight` that of each edge in the sums. The root's similarity is the identity.
    """
    nodes = best_tree(edges, pivots, root, strength, weight, settings)
    inside = np.array([nodes[e.source] is not None and nodes[e.target] is not None for e in edges], dtype=bool)
    connected = [e for e, here in zip(edges, inside, strict=True) if here]
    chi2 = np.full(len(edges), np.inf)  # stays infinite where an end has no pose
    if connected:
        nodes = _optimised(connected, nodes, pivots, root, weight[inside], settings)
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
