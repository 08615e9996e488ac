"""One damped Gauss-Newton step on poses and depths (Levenberg-Marquardt)."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.normal_equations import NormalEquations, normal_equations
from sl_nerfstudio.bundle_adjustment.observations import Kernel
from sl_nerfstudio.bundle_adjustment.parameters import FreeParameters, PriorTerm
from sl_nerfstudio.bundle_adjustment.residuals import Anchors, Linearisation, Observations, Rig, residuals_of

DAMPING = 1e-4  # of the first step, as a share of the normal matrix's diagonal
_RELAX, _TIGHTEN = 5.0, 10.0  # factors by which damping falls after an accepted step, and grows after a rejected one
_LEAST_DAMPING = 1e-9
_TRIES = 8  # rejected steps in a row after which the poses are left unchanged
_LEAST_DEPTH, _MOST_DEPTH = 0.7, 1.4  # factors by which one step may change an anchor's depth
_FACTORISED_FRAMES = 100  # whose whole normal matrix is factorised; for more, steps are found by conjugate gradients
_ITERATIVE_STEPS = 150  # of conjugate gradients, at most
_ITERATIVE_TOLERANCE = 1e-2  # residual of the equations, relative to the first one, at which those end

Solve = Callable[[float], Float[Tensor, "count"] | None]
"""From the damping to the free parameters' step; None if rounding left nothing positive definite."""


def damped_solver(
    equations: NormalEquations,
    prior: tuple[Float[Tensor, "m 12 12"], Float[Tensor, "m 12"]],
    free: FreeParameters,
) -> Solve:
    """A solver of the normal equations with the prior; the damping is a share of the diagonal."""
    g = free.vector(equations.g + prior[1])
    if len(free.frames) > _FACTORISED_FRAMES:
        return _iterative_solver(equations, prior[0], free, g)
    H = free.matrix(equations.matrix(prior[0], g.new_zeros(0)))

    def solve(damping: float) -> Float[Tensor, "count"] | None:
        factor = _damped_factor(H, damping)
        return None if factor is None else torch.cholesky_solve(-g[:, None], factor)[:, 0]

    return solve


def _iterative_solver(
    equations: NormalEquations, prior: Float[Tensor, "m 12 12"], free: FreeParameters, g: Float[Tensor, "count"]
) -> Solve:
    """Conjugate gradients (Agarwal et al., Bundle Adjustment in the Large, ECCV 2010, section 4).

    They start at zero, so every iterate lowers the quadratic model; the blocks on the diagonal precondition: of each
    frame's own parameters, and of those that frames share.
    """

    def product(x: Float[Tensor, "count"]) -> Float[Tensor, "count"]:
        step = free.step(x)
        moving = equations.times(step)[free.frames]
        return free.vector(moving + (prior @ step[free.frames, :, None])[..., 0])

    own = free.own.transpose(1, 2) @ (equations.H + prior) @ free.own
    first = own.shape[0] * own.shape[2]
    shared = torch.zeros(free.count - first, free.count - first, dtype=g.dtype)
    for k in range(len(shared)):
        one = torch.zeros_like(g)
        one[first + k] = 1
        shared[k] = product(one)[first:]

    def solve(damping: float) -> Float[Tensor, "count"] | None:
        diagonal = torch.cat([own.diagonal(dim1=1, dim2=2).flatten(), shared.diagonal()])
        factors = [_damped_factor(block, damping) for block in (own, shared[None])]
        if any(factor is None for factor in factors):
            return None
        x, r = torch.zeros_like(g), -g
        z = _preconditioned(r, factors)
        p, rz = z, float(r @ z)
        enough = _ITERATIVE_TOLERANCE**2 * rz
        for _ in range(_ITERATIVE_STEPS):
            if rz <= enough:
                break
            Hp = product(p) + damping * diagonal * p
            curvature = float(p @ Hp)
            if not curvature > 0:
                break
            x, r = x + rz / curvature * p, r - rz / curvature * Hp
            z = _preconditioned(r, factors)
            rz, before = float(r @ z), rz
            p = z + rz / before * p
        return x

    return solve


def _damped_factor(blocks: Float[Tensor, "*m k k"], damping: float) -> Float[Tensor, "*m k k"] | None:
    damped = blocks.clone()
    damped.diagonal(dim1=-2, dim2=-1).mul_(1 + damping)
    factor, failed = torch.linalg.cholesky_ex(damped)
    return None if bool(failed.any()) else factor


def _preconditioned(r: Float[Tensor, "count"], factors: list[Tensor | None]) -> Float[Tensor, "count"]:
    """Each block's solution."""
    parts, at = [], 0
    for factor in factors:
        assert factor is not None
        m, k, _ = factor.shape
        mine = r[at : at + m * k].reshape(m, k, 1)
        parts.append(torch.cholesky_solve(mine, factor).flatten() if m * k else mine.flatten())
        at += m * k
    return torch.cat(parts)


@dataclass(frozen=True)
class LMState:
    """The current estimate of an adjustment."""

    rig: Rig
    anchors: Anchors
    damping: float
    size: float = 0.0  # largest component of the last step, scene units or radian; 0 if no step lowered the objective
    gain: float = 0.0  # by which the last step lowered the objective, px^2


def lm_step(
    state: LMState,
    linear: Linearisation,
    rows: Observations,
    maps: CoordinateMaps,
    kernel: Kernel,
    prior: PriorTerm,
    free: FreeParameters,
) -> LMState:
    """Take a step along the free parameters, damped until it lowers the whole objective (Levenberg-Marquardt).

    The objective is the robust cost of the residuals that exist before and after the step, plus the prior.
    """
    rig, anchors, r = state.rig, state.anchors, linear.residuals
    if not free.count:
        return LMState(rig, anchors, state.damping)
    equations = normal_equations(linear, rows, *kernel.weights(r), free.frames)
    H_prior, g_prior = (part[free.frames] for part in prior.equations(rig))
    solve = damped_solver(equations, (H_prior, g_prior), free)
    energy = prior.energy(rig)
    damping = state.damping
    for _ in range(_TRIES):
        x = solve(damping)
        if x is None:
            damping = damping * _TIGHTEN
            continue
        step = free.step(x)
        moved, placed = moved_together(rig, anchors, equations, step)
        after = residuals_of(moved, placed, rows, maps)
        both = r.cross_valid & after.cross_valid
        gain = kernel.cost(r, both) + energy - kernel.cost(after, both) - prior.energy(moved)
        if gain > 0:
            damping = max(damping / _RELAX, _LEAST_DAMPING)
            return LMState(moved, placed, damping, float(step.abs().max()), gain)
        damping = damping * _TIGHTEN
    return LMState(rig, anchors, damping)


def moved_together(
    rig: Rig, anchors: Anchors, equations: NormalEquations, step: Float[Tensor, "frames 12"]
) -> tuple[Rig, Anchors]:
    """The rig after a step of its poses, and the anchors, whose depths follow within bounds."""
    depth = anchors.depth + equations.depth_step(step)
    depth = depth.clamp(_LEAST_DEPTH * anchors.depth, _MOST_DEPTH * anchors.depth)
    return rig.moved(step[:, :6], step[:, 6:]), anchors.at(depth)
