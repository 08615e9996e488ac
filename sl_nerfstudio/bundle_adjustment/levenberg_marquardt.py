"""One damped Gauss-Newton step on poses and depths."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.damped_solution import damped_solver
from sl_nerfstudio.bundle_adjustment.free_parameters import FreeParameters
from sl_nerfstudio.bundle_adjustment.normal_equations import NormalEquations, normal_equations
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
    free: FreeParameters,
    settings: StepSettings,
) -> LMState:
    """Take a step along the free parameters, damped until it lowers the whole objective (Levenberg-Marquardt).

    The objective is the robust cost of the residuals that exist before and after the step, plus the prior.
    """
    rig, anchors, r = state.rig, state.anchors, linear.residuals
    if not free.count:
        return LMState(rig, anchors, state.damping)
    equations = normal_equations(linear, rows, *kernel.weights(r), free.frames)
    H_prior, g_prior = (part[free.frames] for part in prior.equations(rig))
    solve = damped_solver(equations, (H_prior, g_prior), free, settings)
    energy = prior.energy(rig)
    damping = state.damping
    for _ in range(settings.tries):
        x = solve(damping)
        if x is None:
            damping = damping * settings.tighten
            continue
        step = free.step(x)
        moved, placed = moved_together(rig, anchors, equations, step, settings)
        after = residuals_of(moved, placed, rows, maps)
        both = r.cross_valid & after.cross_valid
        if kernel.cost(after, both) + prior.energy(moved) < kernel.cost(r, both) + energy:
            damping = max(damping / settings.relax, settings.least_damping)
            return LMState(moved, placed, damping, float(step.abs().max()))
        damping = damping * settings.tighten
    return LMState(rig, anchors, damping)


def moved_together(
    rig: Rig, anchors: Anchors, equations: NormalEquations, step: Float[Tensor, "frames 12"], settings: StepSettings
) -> tuple[Rig, Anchors]:
    """The rig after a step of its poses, and the anchors, whose depths follow within bounds."""
    depth = anchors.depth + equations.depth_step(step)
    depth = depth.clamp(settings.least_depth * anchors.depth, settings.most_depth * anchors.depth)
    return rig.moved(step[:, :6], step[:, 6:]), anchors.at(depth)
