"""Bundle adjustment of all cameras and projectors from decoded coordinates.

Levenberg-Marquardt with a Geman-McClure kernel whose width shrinks from the size of the starting errors to the size of
the noise (graduated non-convexity: Yang et al., RA-L 2020), priors from the stated uncertainty of the starting poses,
and a fixed gauge. See `residuals` for what is minimised, and docs/method.md for why this happens before volume
rendering.
"""

from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Float
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
from sl_nerfstudio.bundle_adjustment.levenberg_marquardt import moved_together
from sl_nerfstudio.bundle_adjustment.normal_equations import normal_equations
from sl_nerfstudio.bundle_adjustment.priors import PosePrior, prior_equations
from sl_nerfstudio.bundle_adjustment.relocalisation import frame_support, unplaced_frames
from sl_nerfstudio.bundle_adjustment.residuals import linearise, residuals_of
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.bundle_adjustment.robust_kernel import frame_medians
from sl_nerfstudio.bundle_adjustment.search.hops import Hopped, hopped
from sl_nerfstudio.bundle_adjustment.search.lost_frames import with_lost_frames
from sl_nerfstudio.bundle_adjustment.search.one_search import search
from sl_nerfstudio.bundle_adjustment.search.problem import FRAMES_MOVE, Problem, Progress, kernel_of, problem_of
from sl_nerfstudio.bundle_adjustment.search.stages import Stage, run_stage
from sl_nerfstudio.bundle_adjustment.self_calibration import (
    UNKNOWNS,
    SelfCalibration,
    linearise_with_intrinsics,
    with_smooth_derivatives,
)
from sl_nerfstudio.bundle_adjustment.settings import AdjustmentSettings
from sl_nerfstudio.threads import one_library_thread, results


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
    start: Rig  # to which the prior belongs: the given one, but for frames whose starting pose proved to be wrong

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
class Minimum:
    """Where a search has ended; whether it is one of several such places has not been asked yet."""

    adjustment: Adjustment  # with the covariance of this minimum alone
    problem: Problem
    refine: RefinePoses
    ends: Hopped | None  # of all searches; None: there was nothing to search

    @one_library_thread()
    def with_other_minima(self) -> Adjustment:
        """The same poses; where they are one of several minima, their covariance covers those of other searches."""
        found = self.adjustment
        if self.ends is None:
            return found
        return replace(found, factor=widened(found.factor, _departures(self, self.ends)))


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
    return find_minimum(start, maps, prior, refine, settings).with_other_minima()


@one_library_thread()
def find_minimum(
    start: Rig,
    maps: CoordinateMaps,
    prior: PosePrior,
    refine: RefinePoses,
    settings: AdjustmentSettings,
) -> Minimum:
    """Adjust all poses together without asking for other minima, for results that may be replaced by later ones."""
    problem = problem_of(start, maps, prior, settings)
    first = search(problem, refine)
    if first is None:
        return Minimum(_unmoved(start, prior, free_parameters(refine, start), settings), problem, refine, None)
    found, before = hopped(problem, refine, first[0]), first[1]
    again = with_lost_frames(problem, refine, found.best)
    if again is not None:
        problem, found = again[0], Hopped(again[1], (), found.settled)
    return Minimum(_result(problem, refine, found.best, before), problem, refine, found)


def _departures(minimum: Minimum, found: Hopped) -> list[Float[Tensor, "unknowns"]]:
    """Where other searches end if the result is one of several minima: increments (delta, rho) from the result."""
    result, refine = minimum.adjustment, minimum.refine
    problem = minimum.problem
    s, generator = problem.settings.other_minima, torch.Generator().manual_seed(problem.settings.seed)
    if s.searches < 1 or refine not in FRAMES_MOVE or result.rig.frames > s.most_frames:
        return []
    ends = list(found.others)
    if not found.settled or not _leads_back(problem, refine, found.best, result, generator):
        ends += _other_ends(problem, refine, result, generator)
    limits = s.worse * _misfits(problem.maps, found.best)
    limits[list(result.unplaced)] = float("inf")
    near = [end for end in ends if not (_misfits(problem.maps, end) > limits).any()]
    return [_departure(end, result) for end in near]


def _other_ends(
    problem: Problem, refine: RefinePoses, result: Adjustment, generator: torch.Generator
) -> list[Progress]:
    """Ends of searches from poses as uncertain as the starting ones, drawn about the result.

    No frame has to agree better with the others than it does there; those that are not placed are not searched for.
    """
    support = frame_support(result.rig, problem.maps, result.noise_px, problem.settings)
    expected = support.nan_to_num() - problem.settings.relocalisation.least_gain
    expected[list(result.unplaced)] = float("-inf")
    searches = problem.settings.other_minima.searches
    starts = [drawn_start(result.rig, problem.prior, refine == "free", generator) for _ in range(searches)]
    ends = results([partial(search, problem.again(start, start, expected), refine) for start in starts])
    return [end[0] for end in ends if end]


def _departure(other: Progress, result: Adjustment) -> Float[Tensor, "unknowns"]:
    """From the result to another one, of the frames that are placed."""
    return departure_of(with_frames_of(other.state.rig, result.rig, result.unplaced), result.rig)


def _misfits(maps: CoordinateMaps, found: Progress) -> Float[Tensor, "frames"]:
    """Median residual of each frame's look-ups."""
    state = found.state
    r = residuals_of(state.rig, state.anchors, found.rows, maps)
    return frame_medians(r, found.pairs, state.rig.frames)


def _leads_back(
    problem: Problem, refine: RefinePoses, found: Progress, result: Adjustment, generator: torch.Generator
) -> bool:
    """Whether some steps lead back to the result from poses beside it."""
    s, state = problem.settings.other_minima, found.state
    delta, rho = shake(result.factor, s.shake_sigmas, generator).reshape(2, -1, 6)
    linear = linearise(state.rig, state.anchors, found.rows, problem.maps)
    kernel = kernel_of(state, found.rows, found.widths, linear.residuals, problem)
    equations = normal_equations(linear, found.rows, *kernel.weights(linear.residuals))
    step = torch.cat([delta, rho], 1)
    rig, anchors = moved_together(state.rig, state.anchors, equations, step, problem.settings.steps)
    beside = replace(state, rig=rig, anchors=anchors)
    back = run_stage(problem, Stage(refine, False, s.shake_steps), replace(found, state=beside))
    left = farthest_frame(result.factor, _departure(back, result))
    return left <= s.most_left * s.shake_sigmas


def _result(problem: Problem, refine: RefinePoses, found: Progress, before: float) -> Adjustment:
    """Poses with their covariance; all residuals have full weight, whichever stage the steps ended in."""
    state, maps = found.state, problem.maps
    linear = linearise(state.rig, state.anchors, found.rows, maps)
    r = linear.residuals
    kernel = kernel_of(state, found.rows, found.widths, r, problem)
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
        unplaced=unplaced_frames(state.rig, maps, found.noise, s),
        start=problem.start,
    )


def _unmoved(start: Rig, prior: PosePrior, free: FreeParameters, settings: AdjustmentSettings) -> Adjustment:
    """The starting poses with the prior's uncertainty, if no step is allowed or no frame sees what another decoded."""
    H, _ = prior_equations(prior, start, start)
    nan = float("nan")
    noise = settings.kernel.noise_floor_px
    factor = torch.block_diag(gauge_free(start, free, H), prior.intrinsics_sigma.diag())
    return Adjustment(start, factor, None, noise, 0, nan, nan, (), start)
