"""Joint adjustment of all cameras and projectors from decoded coordinates.

Second order (Levenberg-Marquardt) with a Geman-McClure kernel whose width shrinks from the size of
the starting errors to the size of the noise (graduated non-convexity: Yang et al., RA-L 2020), priors
from the stated uncertainty of the starting poses, and a fixed gauge. See `linearisation` for the
residuals, and docs/method.md for why this comes before, and not out of, volume rendering.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.covariance import Evidence, gauge_free, pose_covariance
from sl_nerfstudio.bundle_adjustment.free_parameters import RefinePoses, free_parameters
from sl_nerfstudio.bundle_adjustment.levenberg_marquardt import DAMPING, LMState, PriorTerm, lm_step
from sl_nerfstudio.bundle_adjustment.observations import observe, place_anchors
from sl_nerfstudio.bundle_adjustment.priors import PosePrior, prior_equations, rough_trust
from sl_nerfstudio.bundle_adjustment.relocalisation import relocalise
from sl_nerfstudio.bundle_adjustment.residuals import Observations, Rig, linearise, residuals_of
from sl_nerfstudio.bundle_adjustment.robust_kernel import NOISE_FLOOR_PX, Kernel, frame_medians, narrowed, noise_of
from sl_nerfstudio.bundle_adjustment.self_calibration import SelfCalibration, linearise_with_intrinsics
from sl_nerfstudio.progress import track

_OBSERVE_EVERY = 4  # iterations between new choices of which frame sees which anchor
_SETTLED = 0.98  # of its last width: the kernel has stopped shrinking
_SMALL_STEP = 1e-4  # of the scene's radius, or radian: the adjustment has converged
_SEARCHES = 3  # for frames that went astray, at most: those found help to find the others
_EVERYTHING = float("inf")  # pixels: no residual is too large to be looked at


@dataclass
class AdjustmentSettings:
    """How much work the joint adjustment is."""

    anchors_per_frame: int = 600
    """Decoded pixels of each frame that are looked for in other frames."""
    max_anchors: int = 12000
    """The same over all frames, at most: time grows with this number, accuracy with its square root."""
    frames_per_anchor: int = 8
    """Other frames in which each of them is looked for, at most."""
    max_iterations: int = 40
    """Levenberg-Marquardt steps, at most."""
    rigid_iterations: int = 5
    """Steps, at most, in which frames move as a whole before projectors move against their cameras."""
    seed: int = 0
    """Seed of the choice of pixels."""


@dataclass(frozen=True)
class Adjustment:
    """What the joint adjustment found."""

    rig: Rig
    covariance: Float[Tensor, "unknowns unknowns"]  # of (delta, rho), gauge freedom projected out
    intrinsics: SelfCalibration | None  # None where nothing was refined
    noise_px: float  # estimated noise of one look-up, projector pixels
    iterations: int
    median_before_px: float
    median_after_px: float

    @property
    def sigma(self) -> Float[Tensor, "frames 12"]:
        """Posterior 1 sigma of each frame's delta and rho: translation xyz, rotation xyz each."""
        sigma = self.covariance.diagonal().clamp_min(0).sqrt()
        return sigma.reshape(2, self.rig.frames, 6).transpose(0, 1).flatten(1)


@dataclass(frozen=True)
class _Stage:
    """A part of the adjustment."""

    refine: RefinePoses
    rough: bool  # residuals are still made by wrong poses: those of one frame err together, and count as few
    iterations: int  # at most


def _stages(refine: RefinePoses, settings: AdjustmentSettings) -> list[_Stage]:
    """Frames find each other as wholes; then everything moves; then everything moves, trusting every residual.

    As long as poses are wrong, the thousands of residuals of a frame are a handful of independent measurements.
    Counted as thousands they overrule the prior along directions they hardly know, and the scene drifts away.
    """
    rough = max(settings.max_iterations // 2 - settings.rigid_iterations, 1)
    found = [_Stage(refine, True, rough), _Stage(refine, False, settings.max_iterations)]
    if refine in ("free", "rigid-rig"):  # a static projector has its place already
        found.insert(0, _Stage("known-rig", True, settings.rigid_iterations))
    return found


@dataclass(frozen=True)
class _Problem:
    """What does not change during an adjustment."""

    start: Rig
    maps: CoordinateMaps
    prior: PosePrior
    settings: AdjustmentSettings
    generator: torch.Generator

    def observe(self, state: LMState) -> Observations:
        """A new choice of which frame looks for which anchor."""
        return observe(
            state.rig, state.anchors, self.maps, self.settings.frames_per_anchor, _EVERYTHING, self.generator
        )


@dataclass(frozen=True)
class _Found:
    """How far an adjustment has come."""

    state: LMState
    rows: Observations
    widths: Float[Tensor, "frames"]  # of each frame's kernel
    noise: float
    iterations: int

    @property
    def pairs(self) -> Int[Tensor, "2 rows"]:
        """Frame of the anchor, frame that looks for it."""
        return self.rows.pairs(self.state.anchors)

    def at(self, rig: Rig, moved: Bool[Tensor, "frames"]) -> "_Found":
        """The same with some frames elsewhere: their kernels open again."""
        widths = torch.where(moved, torch.full_like(self.widths, float("inf")), self.widths)
        return replace(self, state=LMState(rig, self.state.anchors), widths=widths)


def _run(problem: _Problem, stage: _Stage, found: _Found) -> _Found:
    """Steps of one stage, until nothing moves any more."""
    start, maps = problem.start, problem.maps
    found = replace(found, state=replace(found.state, damping=DAMPING))
    for iteration in track(range(stage.iterations), "Adjusting poses"):
        if stage.rough and iteration % _OBSERVE_EVERY == 0:
            found = replace(found, rows=problem.observe(found.state))
        linear = linearise(found.state.rig, found.state.anchors, found.rows, maps)
        r = linear.residuals
        target = 2 * frame_medians(r, found.pairs, start.frames)
        noise = noise_of(r, float(torch.minimum(found.widths, target).min()))
        widths = narrowed(found.widths, target).clamp_min(3 * noise)
        kernel = Kernel(widths, found.state.anchors.frame, found.pairs)
        rows_of_a_frame = float(r.cross_valid.sum()) / start.frames
        trust = rough_trust(noise, rows_of_a_frame) if stage.rough else noise**2
        H, g = prior_equations(problem.prior, start, found.state.rig)
        B = free_parameters(stage.refine, found.state.rig)
        state = lm_step(found.state, linear, found.rows, maps, kernel, B, PriorTerm(trust * H, trust * g))
        small = state.size < _SMALL_STEP and (state.damping < 1 or state.size == 0)  # or damped to be small
        settled = bool((widths >= _SETTLED * found.widths).all()) and small
        found = _Found(state, found.rows, widths, noise, found.iterations + 1)
        if settled:
            break
    return found


def adjust(
    start: Rig,
    maps: CoordinateMaps,
    prior: PosePrior,
    refine: RefinePoses,
    settings: AdjustmentSettings,
) -> Adjustment:
    """Refine all poses jointly. The scene must be normalised: origin at the object's centre, radius about one.

    The gauge is left where the prior puts it; see `gauge.restore` for pinning the scale. Frames that share nothing
    with others stay where they are.
    """
    generator = torch.Generator().manual_seed(settings.seed)
    per_frame = max(1, min(settings.anchors_per_frame, settings.max_anchors // start.frames))
    anchors = place_anchors(start, maps, per_frame, generator)
    rows = observe(start, anchors, maps, settings.frames_per_anchor, _EVERYTHING, generator)
    r = residuals_of(start, anchors, rows, maps)
    if settings.max_iterations < 1 or not r.cross_valid.any():
        return _unmoved(start, prior, free_parameters(refine, start))
    before = float(r.cross[r.cross_valid].norm(dim=-1).median())
    problem = _Problem(start, maps, prior, settings, generator)
    widths = torch.full((start.frames,), float("inf"), dtype=torch.float64)
    found = _Found(LMState(start, anchors), rows, widths, max(before, NOISE_FLOOR_PX), 0)
    *rough, last = _stages(refine, settings)
    for stage in rough:
        found = _run(problem, stage, found)
    for _ in range(_SEARCHES if refine in ("free", "rigid-rig", "known-rig") else 0):
        home = relocalise(found.state.rig, start, maps, prior, refine, found.noise, generator)
        moved = (home.T_world_camera != found.state.rig.T_world_camera).flatten(1).any(1)
        if not moved.any():
            break
        found = _run(problem, rough[-1], found.at(home, moved))
    found = _run(problem, replace(last, iterations=max(settings.max_iterations - found.iterations, 1)), found)
    state = found.state
    linear = linearise(state.rig, state.anchors, found.rows, maps)
    r, kernel = linear.residuals, Kernel(found.widths, state.anchors.frame, found.pairs)
    inliers = r.cross_valid & (r.cross.norm(dim=-1) < 4 * kernel.narrowest)
    # at the result, with every residual trusted, in whichever stage the steps ended
    extended = linearise_with_intrinsics(linear, state.rig, state.anchors, found.rows, maps)
    evidence = Evidence(state.rig, state.anchors, found.rows, extended, kernel)
    known = pose_covariance(evidence, free_parameters(refine, state.rig), start, prior, found.noise)
    return Adjustment(
        rig=state.rig,
        covariance=known.covariance,
        intrinsics=known.intrinsics,
        noise_px=found.noise,
        iterations=found.iterations,
        median_before_px=before,
        median_after_px=float(r.cross[inliers].norm(dim=-1).median()),
    )


def _unmoved(start: Rig, prior: PosePrior, B: Tensor) -> Adjustment:
    """The starting poses, where no step is asked for or no frame sees what another decoded; known as the prior says."""
    H = B.T @ prior_equations(prior, start, start)[0] @ B
    nan = float("nan")
    return Adjustment(start, gauge_free(start, B, H, 1.0), None, NOISE_FLOOR_PX, 0, nan, nan)
