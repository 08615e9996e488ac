"""One damped Gauss-Newton step on poses and depths."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.residuals import (
    Anchors,
    Linearisation,
    Observations,
    Rig,
    normal_equations,
    residuals_of,
)
from sl_nerfstudio.bundle_adjustment.robust_kernel import Kernel

DAMPING = 1e-4  # of the diagonal, to begin with
_TRIES = 8


@dataclass(frozen=True)
class LMState:
    """Where an adjustment stands."""

    rig: Rig
    anchors: Anchors
    damping: float = DAMPING
    size: float = 0.0  # of the last step: scene units or radian, the largest; 0 where none lowered the cost


@dataclass(frozen=True)
class PriorTerm:
    """What draws the poses besides residuals: information matrix and gradient, in the residuals' weight."""

    H: Float[Tensor, "unknowns unknowns"]
    g: Float[Tensor, "unknowns"]


def lm_step(
    state: LMState,
    linear: Linearisation,
    rows: Observations,
    maps: CoordinateMaps,
    kernel: Kernel,
    B: Float[Tensor, "unknowns k"],
    pull: PriorTerm | None = None,
) -> LMState:
    """A step along the columns of `B` that lowers the cost, damped until it does (Levenberg-Marquardt)."""
    rig, anchors, r, n = state.rig, state.anchors, linear.residuals, state.rig.frames
    if not B.shape[1]:
        return LMState(rig, anchors, state.damping)
    equations = normal_equations(linear, rows, *kernel.weights(r))
    H, g = (equations.H, equations.g) if pull is None else (equations.H + pull.H, equations.g + pull.g)
    H, g = B.T @ H @ B, B.T @ g
    damping = state.damping
    for _ in range(_TRIES):
        x = B @ torch.linalg.solve(H + damping * torch.diag(torch.diag(H)), -g)
        depth = anchors.depth + equations.depth_step(x)
        depth = depth.clamp(0.7 * anchors.depth, 1.4 * anchors.depth)
        moved = rig.moved(x[: 6 * n].reshape(n, 6), x[6 * n :].reshape(n, 6))
        after = residuals_of(moved, anchors.at(depth), rows, maps)
        both = r.cross_valid & after.cross_valid
        if kernel.cost(after, both) < kernel.cost(r, both):
            return LMState(moved, anchors.at(depth), max(damping / 5, 1e-9), float(x.abs().max()))
        damping = damping * 10
    return LMState(rig, anchors, damping)
