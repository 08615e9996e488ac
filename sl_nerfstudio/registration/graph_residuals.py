"""Residuals of the pose graph: the similarity by which an edge and the nodes at its ends disagree.

Increments (v, w, l) of a node act in its own axes, about a pivot c: `p -> c + exp(l) exp(w) (p - c) + radius v`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.pairs.pair_match import PairMatch
from sl_nerfstudio.registration.similarities import Similarities, logs_at

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


@dataclass(frozen=True)
class EdgeArrays:
    """Edges one after the other."""

    source: Int64[ndarray, "e"]
    target: Int64[ndarray, "e"]
    S_target_source: Similarities
    information: Float64[ndarray, "e 7 7"]

    @staticmethod
    def of(edges: Sequence[PairMatch]) -> "EdgeArrays":
        """From at least one."""
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
