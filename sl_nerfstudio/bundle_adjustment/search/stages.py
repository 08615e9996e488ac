"""Steps that follow each other until nothing moves any more."""

from dataclasses import dataclass, replace

import torch

from sl_nerfstudio.bundle_adjustment.free_parameters import RefinePoses, free_parameters
from sl_nerfstudio.bundle_adjustment.levenberg_marquardt import lm_step
from sl_nerfstudio.bundle_adjustment.priors import PriorTerm, rough_weight
from sl_nerfstudio.bundle_adjustment.residuals import linearise
from sl_nerfstudio.bundle_adjustment.robust_kernel import frame_medians, narrowed, noise_of
from sl_nerfstudio.bundle_adjustment.search.problem import Problem, Progress, kernel_of
from sl_nerfstudio.bundle_adjustment.settings import AdjustmentSettings
from sl_nerfstudio.progress import track


@dataclass(frozen=True)
class Stage:
    """A part of the adjustment."""

    refine: RefinePoses
    rough: bool  # residuals still come from wrong poses: those of one frame are correlated and count as few
    iterations: int  # at most


def stages(refine: RefinePoses, settings: AdjustmentSettings) -> list[Stage]:
    """First frames move as a whole; then everything moves; then everything moves with all residuals at full weight.

    While poses are wrong, the thousands of residuals of a frame amount to only a few independent measurements. If they
    counted as thousands, they would overrule the prior along directions that they hardly determine, and the scene would
    drift.
    """
    rough = max(settings.max_iterations // 2 - settings.rigid_iterations, 1)
    found = [Stage(refine, True, rough), Stage(refine, False, settings.max_iterations)]
    if refine in ("free", "rigid-rig"):  # a static projector is already in place
        found.insert(0, Stage("known-rig", True, settings.rigid_iterations))
    return found


def run_stage(problem: Problem, stage: Stage, found: Progress) -> Progress:
    """Take the steps of one stage, until nothing moves any more."""
    start, maps, s = problem.start, problem.maps, problem.settings
    found = replace(found, state=replace(found.state, damping=s.steps.damping))
    for iteration in track(range(stage.iterations), "Adjusting poses"):
        if stage.rough and iteration % s.observe_every == 0:
            found = replace(found, rows=problem.observe(found.state))
        linear = linearise(found.state.rig, found.state.anchors, found.rows, maps)
        r = linear.residuals
        target = s.kernel.medians * frame_medians(r, found.pairs, start.frames)
        noise = noise_of(r, float(torch.minimum(found.widths, target).min()), s.kernel)
        widths = narrowed(found.widths, target, s.kernel).clamp_min(s.kernel.noises * noise)
        kernel = kernel_of(found.state, found.rows, widths, r, problem)
        per_frame = float(r.cross_valid.sum()) / start.frames
        weight = rough_weight(noise, per_frame, s.independent_residuals) if stage.rough else noise**2
        prior = PriorTerm(problem.prior, start, weight)
        free = free_parameters(stage.refine, found.state.rig)
        state = lm_step(found.state, linear, found.rows, maps, kernel, prior, free, s.steps)
        # a step may also be small because it was damped
        small = state.size < s.steps.converged and (state.damping < 1 or state.size == 0)
        settled = bool((widths >= s.steps.settled * found.widths).all()) and small
        found = Progress(state, found.rows, widths, noise, found.iterations + 1)
        if settled:
            break
    return found
