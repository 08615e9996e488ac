"""Bundle adjustment of all cameras and projectors from decoded coordinates.

Levenberg-Marquardt with a Geman-McClure kernel whose width shrinks from the size of the starting errors to the size of
the noise (graduated non-convexity: Yang et al., RA-L 2020), priors from the stated uncertainty of the starting poses,
and a fixed gauge. See `residuals` for what is minimised, and docs/method.md for why this happens before volume
rendering.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.covariance import gauge_free, pose_covariance
from sl_nerfstudio.bundle_adjustment.free_parameters import FreeParameters, RefinePoses, free_parameters
from sl_nerfstudio.bundle_adjustment.joint_covariance.evidence import Evidence
from sl_nerfstudio.bundle_adjustment.joint_covariance.other_minima import (
    departure_of,
    drawn_start,
    farthest_frame,
    shake,
    widened,
    with_frames_of,
)
from sl_nerfstudio.bundle_adjustment.levenberg_marquardt import LMState, lm_step, moved_together
from sl_nerfstudio.bundle_adjustment.normal_equations import normal_equations
from sl_nerfstudio.bundle_adjustment.observations import away_from_borders, observe, partners, place_anchors
from sl_nerfstudio.bundle_adjustment.priors import PosePrior, PriorTerm, prior_equations, rough_weight
from sl_nerfstudio.bundle_adjustment.relocalisation import relocalise, unplaced_frames
from sl_nerfstudio.bundle_adjustment.residuals import (
    Anchors,
    Observations,
    Residuals,
    linearise,
    pixels_of_rows,
    residuals_of,
    viewing_cosines,
)
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.bundle_adjustment.robust_kernel import (
    Kernel,
    frame_medians,
    narrowed,
    noise_of,
    noise_ratios,
    useful_distance,
)
from sl_nerfstudio.bundle_adjustment.self_calibration import (
    UNKNOWNS,
    SelfCalibration,
    linearise_with_intrinsics,
    with_smooth_derivatives,
)
from sl_nerfstudio.bundle_adjustment.settings import AdjustmentSettings
from sl_nerfstudio.geometry.devices import project
from sl_nerfstudio.progress import track
from sl_nerfstudio.threads import one_library_thread

_NO_GATE = float("inf")  # pixels: no residual is too large to be used
_FRAMES_MOVE = ("free", "rigid-rig", "known-rig")


@dataclass(frozen=True)
class Adjustment:
    """What the bundle adjustment found."""

    rig: Rig
    factor: Float[Tensor, "joint k"]  # of the covariance of (delta, rho, intrinsics) without the gauge
    intrinsics: SelfCalibration | None  # None where nothing was adjusted
    noise_px: float  # estimated noise of one look-up, projector pixels
    iterations: int
    median_before_px: float
    median_after_px: float
    unplaced: tuple[int, ...]  # frames that do not agree with the others: neither their poses nor their sigma hold

    @property
    def covariance(self) -> Float[Tensor, "unknowns unknowns"]:
        """That of (delta, rho) alone."""
        return self.factor[:-UNKNOWNS] @ self.factor[:-UNKNOWNS].T

    @property
    def sigma(self) -> Float[Tensor, "frames 12"]:
        """1 sigma of each frame's delta and rho: translation xyz, rotation xyz each."""
        sigma = self.factor[:-UNKNOWNS].norm(dim=1)
        return sigma.reshape(2, self.rig.frames, 6).transpose(0, 1).flatten(1)


@dataclass(frozen=True)
class _Stage:
    """A part of the adjustment."""

    refine: RefinePoses
    rough: bool  # residuals still come from wrong poses: those of one frame are correlated and count as few
    iterations: int  # at most


def _stages(refine: RefinePoses, settings: AdjustmentSettings) -> list[_Stage]:
    """First frames move as a whole; then everything moves; then everything moves with all residuals at full weight.

    While poses are wrong, the thousands of residuals of a frame amount to only a few independent measurements. If they
    counted as thousands, they would overrule the prior along directions that they hardly determine, and the scene would
    drift.
    """
    rough = max(settings.max_iterations // 2 - settings.rigid_iterations, 1)
    found = [_Stage(refine, True, rough), _Stage(refine, False, settings.max_iterations)]
    if refine in ("free", "rigid-rig"):  # a static projector is already in place
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
    partners: Bool[Tensor, "frames frames"]
    anchors: Anchors  # where they are with the starting poses
    unplaced: tuple[int, ...] = ()  # frames that are known to agree with no others: they are not searched for

    def observe(self, state: LMState) -> Observations:
        """A new choice of which frame looks up which anchor."""
        s = self.settings
        return observe(
            state.rig, state.anchors, self.maps, s.frames_per_anchor, _NO_GATE, s.least_cosine, self.generator,
            self.partners,
        )  # fmt: skip


@dataclass(frozen=True)
class _Progress:
    """The current state of an adjustment."""

    state: LMState
    rows: Observations
    widths: Float[Tensor, "frames"]  # of each frame's kernel
    noise: float
    iterations: int

    @property
    def pairs(self) -> Int[Tensor, "2 rows"]:
        """Frame of the anchor, frame that looks it up."""
        return self.rows.pairs(self.state.anchors)

    def at(self, rig: Rig, moved: Bool[Tensor, "frames"]) -> "_Progress":
        """The same with some frames at other poses; the kernels of those frames are wide again."""
        widths = torch.where(moved, torch.full_like(self.widths, float("inf")), self.widths)
        return replace(self, state=replace(self.state, rig=rig), widths=widths)


def _run(problem: _Problem, stage: _Stage, found: _Progress) -> _Progress:
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
        kernel = _kernel(found.state, found.rows, widths, r, problem)
        per_frame = float(r.cross_valid.sum()) / start.frames
        weight = rough_weight(noise, per_frame, s.independent_residuals) if stage.rough else noise**2
        prior = PriorTerm(problem.prior, start, weight)
        free = free_parameters(stage.refine, found.state.rig)
        state = lm_step(found.state, linear, found.rows, maps, kernel, prior, free, s.steps)
        # a step may also be small because it was damped
        small = state.size < s.steps.converged and (state.damping < 1 or state.size == 0)
        settled = bool((widths >= s.steps.settled * found.widths).all()) and small
        found = _Progress(state, found.rows, widths, noise, found.iterations + 1)
        if settled:
            break
    return found


def _kernel(
    state: LMState, rows: Observations, widths: Float[Tensor, "frames"], r: Residuals, problem: _Problem
) -> Kernel:
    """The kernel with the noise that look-ups have by how obliquely a camera sees the surface."""
    cosine = viewing_cosines(state.rig, state.anchors, rows)
    ratio = noise_ratios(r, cosine, problem.settings.kernel)
    return Kernel(widths, state.anchors.frame, rows.pairs(state.anchors), ratio)


@one_library_thread()
def adjust(
    start: Rig,
    maps: CoordinateMaps,
    prior: PosePrior,
    refine: RefinePoses,
    settings: AdjustmentSettings,
) -> Adjustment:
    """Adjust all poses together. The scene must be normalised: origin at the object's centre, radius about one.

    The gauge stays where the prior puts it; `gauge.restore` sets the scale afterwards. Frames that share nothing with
    others do not move.
    """
    problem = _problem(start, maps, prior, settings)
    first = _search(problem, refine)
    if first is None:
        return _unmoved(start, prior, free_parameters(refine, start), settings)
    found, before = first
    return _with_other_minima(problem, refine, found, _result(problem, refine, found, before))


def _problem(start: Rig, maps: CoordinateMaps, prior: PosePrior, settings: AdjustmentSettings) -> _Problem:
    """A search from `start`, to which the prior belongs."""
    generator = torch.Generator().manual_seed(settings.seed)
    per_frame = min(settings.anchors_per_frame, settings.max_anchors // start.frames)
    per_frame = max(per_frame, min(settings.least_anchors_per_frame, settings.anchors_per_frame))
    anchors = place_anchors(start, maps, per_frame, generator)
    together = partners(start, anchors, maps, settings.partners, settings.least_cosine, generator)
    return _Problem(start, maps, prior, settings, generator, together, anchors)


def _search(problem: _Problem, refine: RefinePoses) -> tuple[_Progress, float] | None:
    """All stages, and the median residual at the start; None if there is nothing to search."""
    start, settings = problem.start, problem.settings
    state = LMState(start, problem.anchors, settings.steps.damping)
    rows = problem.observe(state)
    r = residuals_of(start, state.anchors, rows, problem.maps)
    if settings.max_iterations < 1 or not r.cross_valid.any():
        return None
    before = float(r.cross[r.cross_valid].norm(dim=-1).median())
    widths = torch.full((start.frames,), float("inf"), dtype=torch.float64)
    found = _Progress(state, rows, widths, max(before, settings.kernel.noise_floor_px), 0)
    *rough, last = _stages(refine, settings)
    for stage in rough:
        found = _run(problem, stage, found)
    found = _relocalised(problem, refine, rough[-1], found)
    found = _away_from_borders(problem, found)
    found = _run(problem, replace(last, iterations=max(settings.max_iterations - found.iterations, 1)), found)
    return found, before


def _away_from_borders(problem: _Problem, found: _Progress) -> _Progress:
    """Without look-ups so near to the border of what was decoded that their residuals are larger than usual."""
    state, maps, s = found.state, problem.maps, problem.settings.kernel
    anchors, rows = state.anchors, found.rows
    r = residuals_of(state.rig, anchors, rows, maps)
    own = maps.border_distance(anchors.frame, project(state.rig.camera[anchors.frame], anchors.d_camera)[0])
    seen = maps.border_distance(rows.frame, pixels_of_rows(state.rig, anchors, rows)[0])
    size = r.cross.norm(dim=-1) / noise_ratios(r, viewing_cosines(state.rig, anchors, rows), s)
    nearer = torch.minimum(own[rows.anchor], seen)
    least = useful_distance(nearer[r.cross_valid], size[r.cross_valid], s)
    if least <= 0:
        return found
    anchors, rows = away_from_borders(anchors, rows, (own, seen), least, state.rig.frames)
    return replace(found, state=replace(state, anchors=anchors), rows=rows)


def _with_other_minima(problem: _Problem, refine: RefinePoses, found: _Progress, result: Adjustment) -> Adjustment:
    """The result; where it is one of several, its covariance covers those that other searches find."""
    s, generator = problem.settings.other_minima, torch.Generator().manual_seed(problem.settings.seed)
    asked = s.searches > 0 and refine in _FRAMES_MOVE and result.rig.frames <= s.most_frames
    problem = replace(problem, unplaced=result.unplaced)
    if not asked or _leads_back(problem, refine, found, result, generator):
        return result
    limits = s.worse * _misfits(problem.maps, found)
    limits[list(result.unplaced)] = float("inf")
    departures = []
    for _ in range(s.searches):
        start = drawn_start(result.rig, problem.prior, refine == "free", generator)
        again = replace(_problem(start, problem.maps, problem.prior, problem.settings), unplaced=result.unplaced)
        other = _search(again, refine)
        if other is not None and not (_misfits(problem.maps, other[0]) > limits).any():
            departures.append(_departure(problem, other[0], result))
    return replace(result, factor=widened(result.factor, departures))


def _departure(problem: _Problem, other: _Progress, result: Adjustment) -> Float[Tensor, "unknowns"]:
    """From the result to another one, of the frames that are placed."""
    return departure_of(with_frames_of(other.state.rig, result.rig, problem.unplaced), result.rig)


def _misfits(maps: CoordinateMaps, found: _Progress) -> Float[Tensor, "frames"]:
    """Median residual of each frame's look-ups."""
    state = found.state
    r = residuals_of(state.rig, state.anchors, found.rows, maps)
    return frame_medians(r, found.pairs, state.rig.frames)


def _leads_back(
    problem: _Problem, refine: RefinePoses, found: _Progress, result: Adjustment, generator: torch.Generator
) -> bool:
    """Whether some steps lead back to the result from poses beside it."""
    s, state = problem.settings.other_minima, found.state
    delta, rho = shake(result.factor, s.shake_sigmas, generator).reshape(2, -1, 6)
    linear = linearise(state.rig, state.anchors, found.rows, problem.maps)
    kernel = _kernel(state, found.rows, found.widths, linear.residuals, problem)
    equations = normal_equations(linear, found.rows, *kernel.weights(linear.residuals))
    step = torch.cat([delta, rho], 1)
    rig, anchors = moved_together(state.rig, state.anchors, equations, step, problem.settings.steps)
    beside = replace(state, rig=rig, anchors=anchors)
    back = _run(problem, _Stage(refine, False, s.shake_steps), replace(found, state=beside))
    left = farthest_frame(result.factor, _departure(problem, back, result))
    return left <= s.most_left * s.shake_sigmas


def _relocalised(problem: _Problem, refine: RefinePoses, stage: _Stage, found: _Progress) -> _Progress:
    """Place lost frames again and adjust everything with them, until no frame moves any more."""
    if refine not in _FRAMES_MOVE:
        return found
    for _ in range(problem.settings.relocalisation.rounds):
        rig = relocalise(
            found.state.rig, problem.start, problem.maps, problem.prior, refine, found.noise, problem.generator,
            problem.settings, problem.unplaced,
        )  # fmt: skip
        moved = (rig.T_world_camera != found.state.rig.T_world_camera).flatten(1).any(1)
        if not moved.any():
            break
        found = _run(problem, stage, found.at(rig, moved))
    return found


def _result(problem: _Problem, refine: RefinePoses, found: _Progress, before: float) -> Adjustment:
    """Poses with their covariance; all residuals have full weight, whichever stage the steps ended in."""
    state, maps = found.state, problem.maps
    linear = linearise(state.rig, state.anchors, found.rows, maps)
    r = linear.residuals
    kernel = _kernel(state, found.rows, found.widths, r, problem)
    inliers = r.cross_valid & (r.cross.norm(dim=-1) < 4 * kernel.narrowest)
    extended = linearise_with_intrinsics(linear, state.rig, state.anchors, found.rows, maps)
    smooth = with_smooth_derivatives(extended, state.rig, state.anchors, found.rows, maps)
    s = problem.settings
    evidence = Evidence(
        state.rig, state.anchors, found.rows, extended, smooth, kernel, s.image_blocks, s.kernel.least_curvature
    )
    free = free_parameters(refine, state.rig)
    known = pose_covariance(evidence, free, problem.start, problem.prior, found.noise)
    return Adjustment(
        rig=state.rig,
        factor=known.factor,
        intrinsics=known.intrinsics,
        noise_px=found.noise,
        iterations=found.iterations,
        median_before_px=before,
        median_after_px=float(r.cross[inliers].norm(dim=-1).median()),
        unplaced=unplaced_frames(state.rig, problem.maps, found.noise, problem.settings),
    )


def _unmoved(start: Rig, prior: PosePrior, free: FreeParameters, settings: AdjustmentSettings) -> Adjustment:
    """The starting poses with the prior's uncertainty, if no step is allowed or no frame sees what another decoded."""
    H, _ = prior_equations(prior, start, start)
    nan = float("nan")
    noise = settings.kernel.noise_floor_px
    factor = torch.block_diag(gauge_free(start, free, H), prior.intrinsics_sigma.diag())
    return Adjustment(start, factor, None, noise, 0, nan, nan, ())
