"""One damped Gauss-Newton step on poses and depths."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.normal_equations import normal_equations
from sl_nerfstudio.bundle_adjustment.priors import PriorTerm
from sl_nerfstudio.bundle_adjustment.residuals import Anchors, Linearisation, Observations, residuals_of
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.bundle_adjustment.robust_kernel import Kernel
from sl_nerfstudio.bundle_adjustment.settings import StepSettings


@dataclass(frozen=True)
class LMState:
    """The current estimate of an adjustment."""

    rig: Rig
    anchors: Anchors
    damping: float
    size: float = 0.0  # largest component of the last step, scene units or radian; 0 if no step lowered the objective


def lm_step(
    state: LMState,
    linear: Linearisation,
    rows: Observations,
    maps: CoordinateMaps,
    kernel: Kernel,
    prior: PriorTerm,
    B: Float[Tensor, "unknowns k"],
    settings: StepSettings,
) -> LMState:
    """Take a step along the columns of `B`, damped until it lowers the whole objective (Levenberg-Marquardt).

    The objective is the robust cost of the residuals that exist before and after the step, plus the prior.
    """
    rig, anchors, r, n = state.rig, state.anchors, linear.residuals, state.rig.frames
    if not B.shape[1]:
        return LMState(rig, anchors, state.damping)
    equations = normal_equations(linear, rows, *kernel.weights(r))
    H_prior, g_prior = prior.equations(rig)
    H, g = B.T @ (equations.H + H_prior) @ B, B.T @ (equations.g + g_prior)
    energy = prior.energy(rig)
    damping = state.damping
    for _ in range(settings.tries):
        x = B @ torch.linalg.solve(H + damping * torch.diag(torch.diag(H)), -g)
        depth = anchors.depth + equations.depth_step(x)
        depth = depth.clamp(settings.least_depth * anchors.depth, settings.most_depth * anchors.depth)
        moved = rig.moved(x[: 6 * n].reshape(n, 6), x[6 * n :].reshape(n, 6))
        after = residuals_of(moved, anchors.at(depth), rows, maps)
        both = r.cross_valid & after.cross_valid
        if kernel.cost(after, both) + prior.energy(moved) < kernel.cost(r, both) + energy:
            damping = max(damping / settings.relax, settings.least_damping)
            return LMState(moved, anchors.at(depth), damping, float(x.abs().max()))
        damping = damping * settings.tighten
    return LMState(rig, anchors, damping)
