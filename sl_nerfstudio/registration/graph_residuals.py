"""Residuals of the pose graph: the similarity by which an edge and the nodes at its ends disagree.

Increments (v, w, l) of a node act in its own axes, about a pivot c: `p -> c + exp(l) exp(w) (p - c) + radius v`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.increments import log_at
from sl_nerfstudio.registration.pairs.pair_match import PairMatch

Nodes = Sequence[Similarity | None]  # S_world_camera of every frame; None where it is not known


@dataclass(frozen=True)
class Pivots:
    """Of every frame, the point about which increments rotate and scale, and the length that a radian counts as."""

    centre: Float64[ndarray, "n 3"]  # camera axes, units of the frame's baseline
    radius: Float64[ndarray, "n"]

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.radius)


def node_at(nodes: Nodes, k: int) -> Similarity:
    """The similarity of a frame. Raises ValueError where it is not known."""
    S = nodes[k]
    if S is None:
        raise ValueError(f"frame {k} has no pose in the graph")
    return S


def residual(edge: PairMatch, nodes: Nodes, pivots: Pivots) -> Float64[ndarray, "7"]:
    """Increment (v, w, l) in the target's axes, lengths in its radii, by which nodes and edge disagree."""
    D = node_at(nodes, edge.target).inverse() @ node_at(nodes, edge.source) @ edge.S_target_source.inverse()
    return log_at(D, pivots.centre[edge.target], pivots.radius[edge.target])


def chi_square(edges: Sequence[PairMatch], nodes: Nodes, pivots: Pivots) -> Float64[ndarray, "edges"]:
    """Squared residuals in units of the edges' covariances."""
    residuals = [residual(e, nodes, pivots) for e in edges]
    return np.array([x @ e.information @ x for x, e in zip(residuals, edges, strict=True)])


def adjoint(edge: PairMatch, pivots: Pivots) -> Float64[ndarray, "7 7"]:
    """Matrix that turns an increment in the source's axes into one in the target's."""
    S, radius = edge.S_target_source, pivots.radius[edge.target]
    lever = (pivots.centre[edge.target] - S.points(pivots.centre[edge.source][None])[0]) / radius
    A = np.zeros((7, 7))
    A[:3, :3] = S.scale * S.R * pivots.radius[edge.source] / radius
    A[:3, 3:6] = -np.cross(lever, S.R.T).T  # (R w) x lever
    A[:3, 6] = lever
    A[3:6, 3:6] = S.R
    A[6, 6] = 1.0
    return A
