"""Weighted normal equations of the bundle adjustment; the depths of the anchors are eliminated (Schur complement)."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.residuals import Linearisation, Observations
from sl_nerfstudio.compiled import compiled_range
from sl_nerfstudio.threads import threads


@dataclass(frozen=True)
class NormalEquations:
    """Gauss-Newton equations of all unknowns except the depths, which are eliminated."""

    H: Float[Tensor, "unknowns unknowns"]
    g: Float[Tensor, "unknowns"]
    depth_by_rest: Float[Tensor, "anchors unknowns"]
    H_depth: Float[Tensor, "anchors"]
    g_depth: Float[Tensor, "anchors"]

    def depth_step(self, step: Float[Tensor, "unknowns"]) -> Float[Tensor, "anchors"]:
        """Change of the depths that follows from a step of the other unknowns."""
        return -(self.g_depth + self.depth_by_rest @ step) / self.H_depth


def normal_equations(
    linear: Linearisation,
    observations: Observations,
    own_weight: Float[Tensor, "anchors"],
    cross_weight: Float[Tensor, "rows"],
) -> NormalEquations:
    """Weighted normal equations with the Schur complement of the depths."""
    size, rows, r_of = linear.unknowns, observations.anchor, linear.residuals
    H = torch.zeros(size, size, dtype=torch.float64)
    g = torch.zeros(size, dtype=torch.float64)
    depth_by_rest = torch.zeros(len(own_weight) * size, dtype=torch.float64)
    H_depth = own_weight * (linear.own_depth**2).sum(-1)
    g_depth = own_weight * (linear.own_depth * r_of.own).sum(-1)
    groups = (
        (linear.own, linear.own_depth, r_of.own, own_weight, linear.own_columns, torch.arange(len(own_weight))),
        (linear.cross, linear.cross_depth, r_of.cross, cross_weight, linear.cross_columns, rows),
    )
    for J, J_depth, r, w, cols, anchor in groups:
        wJ = w[:, None, None] * J
        g.index_add_(0, cols.reshape(-1), (wJ[:, 0] * r[:, :1] + wJ[:, 1] * r[:, 1:]).reshape(-1))
        coupling = wJ[:, 0] * J_depth[:, :1] + wJ[:, 1] * J_depth[:, 1:]
        depth_by_rest.index_add_(0, (anchor[:, None] * size + cols).reshape(-1), coupling.reshape(-1))
        partial = np.zeros((threads(), size, size))
        _accumulate(len(partial), J.numpy(), w.numpy(), cols.numpy(), partial)
        H += torch.from_numpy(partial.sum(0))
    H = torch.tril(H) + torch.tril(H, -1).T
    H_depth = H_depth.index_add(0, rows, cross_weight * (linear.cross_depth**2).sum(-1))
    g_depth = g_depth.index_add(0, rows, cross_weight * (linear.cross_depth * linear.residuals.cross).sum(-1))
    H_depth = H_depth.clamp_min(1e-12)
    V = depth_by_rest.reshape(-1, size)
    scaled = V / H_depth[:, None]
    return NormalEquations(H - V.T @ scaled, g - scaled.T @ g_depth, V, H_depth, g_depth)


@compiled_range
def _accumulate(first, last, J, weight, columns, partial):
    """Lower triangle of `sum_n w_n J_n^T J_n`, in partial sums, one per thread."""
    parts, rows, width = partial.shape[0], J.shape[0], J.shape[2]
    for t in range(first, last):
        for n in range(t * rows // parts, (t + 1) * rows // parts):
            w = weight[n]
            if w > 0:
                for a in range(width):
                    x, y, ca = w * J[n, 0, a], w * J[n, 1, a], columns[n, a]
                    for b in range(width):
                        if columns[n, b] <= ca:
                            partial[t, ca, columns[n, b]] += x * J[n, 0, b] + y * J[n, 1, b]
