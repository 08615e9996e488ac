"""Bundle adjustment of all cameras and projectors from decoded coordinates.

Levenberg-Marquardt with a Geman-McClure kernel whose width shrinks from the size of the starting errors to the size of
the noise (graduated non-convexity: Yang et al., RA-L 2020), priors from the stated uncertainty of the starting poses,
and a fixed gauge. See `residuals` for what is minimised, and docs/method.md for why this happens before volume
rendering.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int, Int64
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.covariance import (
    CovarianceEvidence,
    departure_of,
    drawn_start,
    farthest_frame,
    gauge_free,
    pose_covariance,
    shake,
    widened,
    with_frames_of,
)
from sl_nerfstudio.bundle_adjustment.levenberg_marquardt import moved_together
from sl_nerfstudio.bundle_adjustment.normal_equations import normal_equations
from sl_nerfstudio.bundle_adjustment.observations import anchors_at, frame_medians, in_front_of, observe, partners
from sl_nerfstudio.bundle_adjustment.parameters import (
    UNKNOWNS,
    FreeParameters,
    PosePrior,
    PriorTerm,
    RefinePoses,
    SelfCalibration,
    alignment,
    baseline_scale,
    free_parameters,
    linearise_with_intrinsics,
    prior_equations,
    with_smooth_derivatives,
)
from sl_nerfstudio.bundle_adjustment.residuals import Anchors, Observations, Rig, linearise, residuals_of
from sl_nerfstudio.bundle_adjustment.search import (
    FRAMES_MOVE,
    SearchProblem,
    SearchProgress,
    SearchStage,
    frame_support,
    kernel_of,
    problem_of,
    run_stage,
    search,
    unplaced_frames,
)
from sl_nerfstudio.bundle_adjustment.settings import AdjustmentSettings
from sl_nerfstudio.geometry.devices import PARAMETERS, Device, Intrinsics, unproject
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.geometry.numerics import geman_mcclure_cost
from sl_nerfstudio.geometry.triangulation import closest_approach
from sl_nerfstudio.parallel import one_library_thread, results
from sl_nerfstudio.registration.register import register
from sl_nerfstudio.registration.surfaces import FrameCloud, frame_cloud
from sl_nerfstudio.relative_pose.epipolar import correspondences_of, lattice_step
from sl_nerfstudio.relative_pose.estimation import RelativePoseError, relative_pose_near

# Where the surfaces of single frames fit together, as another place to begin a search: for rough starts, lost
# frames.
#
# Look-ups compare coordinates at one place and lead a frame home from about its own details away. Each frame alone
# shows a surface, too, from its coordinates and the pose of its projector, and surfaces can be registered from much
# farther.

_FEWEST = 2  # frames that a registration may join


def registered_start(problem: SearchProblem, refine: RefinePoses, beside: Rig, known: Sequence[int]) -> Rig | None:
    """A rig with frames where the registration of their surfaces puts them; None if it joins too few.

    `known` frames of the rig `beside` give the axes and the scale; the others may be anywhere. A frame that was not
    joined stays where it is there. Projectors move only where they are free.
    """
    start = problem.start
    clouds = [c for c in results([partial(_cloud, problem, k) for k in range(start.frames)]) if c is not None]
    frame = np.array([int(c.name) for c in clouds])
    if len(clouds) < _FEWEST:
        return None
    roughly = start.T_world_camera.numpy()[frame]
    roughly[~np.isin(frame, list(known))] = np.nan
    found = register(clouds, False, problem.settings.seed, roughly)
    joined = np.flatnonzero(found.registered)
    common = np.isin(frame[joined], list(known))
    if common.sum() < _FEWEST:
        return None
    cameras, relative = found.T_world_camera[joined], np.stack([clouds[k].pose.T_camera_projector for k in joined])
    relative[:, :3, 3] *= found.baseline[joined, None]
    reference = _frames(beside, frame[joined][common])
    same = replace(reference, **_poses(cameras[common], relative[common]))
    scale = baseline_scale(reference, same, None)
    S = alignment(reference, same, scale) @ Similarity.scaling(scale)
    camera, projector = beside.T_world_camera.numpy().copy(), beside.T_camera_projector.numpy().copy()
    camera[frame[joined]] = S.poses(cameras)
    if refine == "free":
        relative[:, :3, 3] *= scale
        projector[frame[joined]] = relative
    return replace(beside, **_poses(camera, projector))


def _poses(camera: Float64[ndarray, "n 4 4"], relative: Float64[ndarray, "n 4 4"]) -> dict[str, Tensor]:
    return {"T_world_camera": torch.from_numpy(camera), "T_camera_projector": torch.from_numpy(relative)}


def _frames(rig: Rig, index: Int64[ndarray, "n"]) -> Rig:
    chosen = torch.from_numpy(index)
    return Rig(rig.camera[chosen], rig.projector, rig.T_world_camera[chosen], rig.T_camera_projector[chosen])


def _cloud(problem: SearchProblem, k: int) -> FrameCloud | None:
    """The surface of one frame, named by its number; None where too little of it was decoded."""
    rig, s = problem.start, problem.settings.hops
    coords = _thinned(problem.maps.image(k).numpy(), s.registered_side)
    uv_camera, uv_projector = correspondences_of(coords)
    if len(uv_camera) < s.registered_pixels:
        return None
    h, w = coords.shape[:2]
    lit = np.ceil(uv_projector.max(0)).astype(int)  # the part of the pattern that matters
    devices = _device(rig.camera[k], w, h), _device(rig.projector, int(lit[0]), int(lit[1]))
    try:
        pose = relative_pose_near(rig.T_camera_projector[k].numpy(), uv_camera, uv_projector, *devices)
        return frame_cloud(str(k), coords, *devices, pose)
    except RelativePoseError:  # hardly any coordinate agrees with a pose near the stated one
        return None


def _thinned(image: ndarray, side: int) -> Float32[ndarray, "h w 2"]:
    """Only every n-th decoded pixel of an image that is much larger than surfaces are compared at."""
    used = lattice_step(*image.shape[:2])  # correspondences are taken there only: a multiple loses none of the kept
    step = used * max(round(max(image.shape[:2]) / (used * side)), 1)
    kept = np.full_like(image, np.nan, dtype=np.float32)
    kept[::step, ::step] = image[::step, ::step]
    return kept


def _device(intrinsics: Intrinsics, w: int, h: int) -> Device:
    values = dict(zip(PARAMETERS, intrinsics.params.tolist(), strict=True))
    return Device(w, h, **values, model=intrinsics.model)


# Which of two ends of searches is more probable: the whole posterior, of the look-ups that exist at both.
#
# What exists at one end alone says nothing by itself: frames that are turned onto one side of a round object see each
# other more than they do where they belong, and agree as far as the object is round. So both ends are asked the same:
# an anchor is the same pixel of the same frame, at the depth that each end gives it, and the same frames look it up.

_HIDDEN = 2.0  # widths of the kernel from which on a nearer surface is another one, which hides the anchor


def log_odds(problem: SearchProblem, end: SearchProgress, other: SearchProgress) -> float:
    """Logarithm of how many times as probable one end is as another, in nats: below zero if it is less probable.

    A contradiction costs a fixed amount, however far off it is. A camera that sees another surface in front of the
    anchor says nothing. Look-ups of a frame are correlated: together they count as `independent_residuals`, however
    many they are. The prior counts in full, so an end far from the starting poses must explain far better what both
    explain.
    """
    s, (one, two) = problem.settings, (end.state.rig, other.state.rig)
    generator = torch.Generator().manual_seed(s.seed)
    drawn = problem.maps.draw(torch.arange(one.frames), s.hops.anchors_per_frame, generator)
    (mine, good), (theirs, as_good) = (
        anchors_at(rig, problem.maps, drawn.frame, drawn.uv_camera) for rig in (one, two)
    )
    ends = [(one, mine.chosen(good & as_good)), (two, theirs.chosen(good & as_good))]
    rows = _common(problem, ends, generator)
    found = [residuals_of(rig, anchors, rows, problem.maps) for rig, anchors in ends]
    width, frames = s.hops.width_noises * min(end.noise, other.noise), one.frames
    common = found[0].cross_valid & found[1].cross_valid
    for (rig, anchors), r in zip(ends, found, strict=True):
        far = r.cross.norm(dim=-1) > _HIDDEN * width
        common &= ~(far & in_front_of(rig, anchors, rows, problem.maps))
    cost, cost_other = (
        float(geman_mcclure_cost((torch.cat([r.own, r.cross[common]]) / width).square().sum(-1)).sum()) for r in found
    )
    nats = s.hops.width_noises**2 / 2  # of a look-up that contradicts
    share = min(s.independent_residuals * frames / max(int(common.sum()), 1), 1.0)
    prior = PriorTerm(problem.prior, problem.start, 0.5)
    return nats * share * (cost_other - cost) + prior.energy(two) - prior.energy(one)


def _common(problem: SearchProblem, ends: list[tuple[Rig, Anchors]], generator: torch.Generator) -> Observations:
    """Anchors in frames that see them at both ends; a random choice of these if there are too many."""
    s = problem.settings
    allowed = torch.stack([partners(*end, problem.maps, s.partners, s.least_cosine, generator) for end in ends]).any(0)
    first, second = (_numbers(problem, *end, allowed, generator) for end in ends)
    common = first[torch.isin(first, second)]
    most = s.relocalisation.frames_per_anchor * len(ends[0][1].frame)
    chosen = common[torch.randperm(len(common), generator=generator)[:most].sort().values]
    frames = ends[0][0].frames
    return Observations(chosen // frames, chosen % frames)


def _numbers(
    problem: SearchProblem, rig: Rig, anchors: Anchors, allowed: Tensor, generator: torch.Generator
) -> Int[Tensor, "rows"]:
    """Every look-up of an end as one number: of its anchor, then of the frame that looks it up."""
    least = problem.settings.least_cosine
    rows = observe(rig, anchors, problem.maps, rig.frames, float("inf"), least, generator, allowed)
    return rows.anchor * rig.frames + rows.frame


# After rough starts: a search is begun again beside its end, and goes on from wherever is more probable.
#
# From starting poses that are off by several degrees some frames end in a minimum of their own, where two or three of
# them agree with each other and well enough with the rest. Poses drawn about that end let them out again, while the
# frames that are right return. (Basin hopping: Wales and Doye, J. Phys. Chem. A, 1997; only what is better is kept.)

_HALF = 0.5  # share of the frames that every second hop moves


@dataclass(frozen=True)
class Hopped:
    """Where further searches have ended."""

    best: SearchProgress
    others: tuple[SearchProgress, ...]  # where those after the best one have ended, if it was elsewhere
    settled: bool  # the last one led back, or none was asked for


def hopped(problem: SearchProblem, refine: RefinePoses, found: SearchProgress) -> Hopped:
    """The end of the search, or a better one; ends as soon as a hop leads back to the best one, or none is better.

    The first hop begins where a registration of the frames' surfaces puts them. Frames that agree with no others at the
    first end are not searched for again.
    """
    s, generator = problem.settings.hops, torch.Generator().manual_seed(problem.settings.seed)
    possible = refine in FRAMES_MOVE and found.state.rig.frames <= s.most_frames
    if s.most < 1 or not possible or not is_rough(problem.prior, s.from_deg):
        return Hopped(found, (), True)
    best, others = found, []
    unplaced = unplaced_frames(found.state.rig, problem.maps, found.noise, problem.settings)
    expected = problem.expected.clone()
    expected[list(unplaced)] = float("-inf")
    registered = registered_start(problem, refine, problem.start, range(problem.start.frames))
    for hop in range(s.most):
        if hop == 0 and registered is not None:
            again = problem.again(problem.start, registered, problem.expected)
        else:
            begin = _moved(best.state.rig, problem.prior, s.size, 1.0 if hop % 2 else _HALF, generator)
            again = problem.again(problem.start, begin, expected)
        end = search(again, refine)
        if end is None:
            continue
        other = end[0]
        if log_odds(problem, other, best) > s.least_gain:
            best, others = other, []
        elif _leads_back(with_frames_of(other.state.rig, best.state.rig, unplaced), best.state.rig, problem):
            return Hopped(best, tuple(others), True)
        else:
            others.append(other)
            if len(others) == s.patience:
                break
    return Hopped(best, tuple(others), False)


def _leads_back(other: Rig, best: Rig, problem: SearchProblem) -> bool:
    """Whether every frame has come back, most of the way that hops take it."""
    s = problem.settings.hops
    departure = departure_of(other, best).reshape(2, -1, 6)[0] / (s.size * problem.prior.sigma[:, :6])
    return float(departure.square().mean(1).max().sqrt()) <= s.most_left


def is_rough(prior: PosePrior, from_deg: float) -> bool:
    """Whether the starting poses of most frames are as uncertain as that."""
    return float(torch.rad2deg(prior.frame_rotation).median()) >= from_deg


def _moved(rig: Rig, prior: PosePrior, size: float, share: float, generator: torch.Generator) -> Rig:
    """Some frames as a whole at poses drawn about theirs, with a share of the uncertainty of the starting poses."""
    chosen = torch.rand(rig.frames, 1, generator=generator, dtype=torch.float64) < share
    draw = torch.randn(rig.frames, 6, generator=generator, dtype=torch.float64)
    delta = torch.where(chosen, size * draw * prior.sigma[:, :6], torch.zeros_like(draw))
    return rig.moved(delta, torch.zeros_like(delta))


# Frames that agree with no others after a search: their surfaces may show where they belong, however far that is.


def with_lost_frames(
    problem: SearchProblem, refine: RefinePoses, found: SearchProgress
) -> tuple[SearchProblem, SearchProgress] | None:
    """The problem and the end of a search with lost frames where their surfaces put them; None if none is found there.

    The stated uncertainty of such a frame's starting pose was wrong: from now on it holds about the new place. What was
    known of its projector against its camera stays.
    """
    s = problem.settings.hops
    if not s.lost_by_surface or refine not in FRAMES_MOVE or problem.start.frames > s.most_frames:
        return None
    lost = _lost(problem, found)
    others = [k for k in range(problem.start.frames) if k not in lost]
    rig = registered_start(problem, refine, found.state.rig, others) if lost else None
    if rig is None:
        return None
    begin = with_frames_of(found.state.rig, rig, lost)
    start = replace(problem.start, T_world_camera=with_frames_of(problem.start, rig, lost).T_world_camera)
    end = search(problem.again(start, begin, problem.expected), refine)
    if end is None or not set(_lost(problem, end[0])) < set(lost):
        return None
    return replace(problem, start=start), end[0]


def _lost(problem: SearchProblem, found: SearchProgress) -> tuple[int, ...]:
    return unplaced_frames(found.state.rig, problem.maps, found.noise, problem.settings)


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
    problem: SearchProblem
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
    if not found.settled or not _adjust_leads_back(problem, refine, found.best, result, generator):
        ends += _other_ends(problem, refine, result, generator)
    limits = s.worse * _misfits(problem.maps, found.best)
    limits[list(result.unplaced)] = float("inf")
    near = [end for end in ends if not (_misfits(problem.maps, end) > limits).any()]
    return [_departure(end, result) for end in near]


def _other_ends(
    problem: SearchProblem, refine: RefinePoses, result: Adjustment, generator: torch.Generator
) -> list[SearchProgress]:
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


def _departure(other: SearchProgress, result: Adjustment) -> Float[Tensor, "unknowns"]:
    """From the result to another one, of the frames that are placed."""
    return departure_of(with_frames_of(other.state.rig, result.rig, result.unplaced), result.rig)


def _misfits(maps: CoordinateMaps, found: SearchProgress) -> Float[Tensor, "frames"]:
    """Median residual of each frame's look-ups."""
    state = found.state
    r = residuals_of(state.rig, state.anchors, found.rows, maps)
    return frame_medians(r, found.pairs, state.rig.frames)


def _adjust_leads_back(
    problem: SearchProblem, refine: RefinePoses, found: SearchProgress, result: Adjustment, generator: torch.Generator
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
    back = run_stage(problem, SearchStage(refine, False, s.shake_steps), replace(found, state=beside))
    left = farthest_frame(result.factor, _departure(back, result))
    return left <= s.most_left * s.shake_sigmas


def _result(problem: SearchProblem, refine: RefinePoses, found: SearchProgress, before: float) -> Adjustment:
    """Poses with their covariance; all residuals have full weight, whichever stage the steps ended in."""
    state, maps = found.state, problem.maps
    linear = linearise(state.rig, state.anchors, found.rows, maps)
    r = linear.residuals
    kernel = kernel_of(state, found.rows, found.widths, r, problem)
    inliers = r.cross_valid & (r.cross.norm(dim=-1) < 4 * kernel.narrowest)
    extended = linearise_with_intrinsics(linear, state.rig, state.anchors, found.rows, maps)
    smooth = with_smooth_derivatives(extended, state.rig, state.anchors, found.rows, maps)
    s = problem.settings
    evidence = CovarianceEvidence(
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


# Are adjusted poses better? Pixels that took no part in the adjustment decide, by a paired comparison.
#
# Each held-out pixel has the same residuals under both sets of poses. So the mean of their differences is compared
# with zero, rather than two means with each other. Residuals within a small block of an image depend on each other:
# blocks are the independent samples from which the standard error follows.


@dataclass(frozen=True)
class HeldOutPixels:
    """Decoded pixels that the adjustment never saw."""

    frame: Int[Tensor, "n"]
    uv_camera: Float[Tensor, "n 2"]
    uv_projector: Float[Tensor, "n 2"]
    block: Int[Tensor, "n"]  # number of the block of pixels, over all frames


@dataclass(frozen=True)
class CrossValidation:
    """How well held-out pixels agree with two sets of poses; robust residuals in projector pixels."""

    before_px: float  # robust RMS residual with the old poses
    after_px: float
    difference: float  # mean of the paired differences of squared robust residuals, after minus before, px^2
    standard_error: float  # of that mean; infinite for fewer than two blocks
    standard_errors: float  # by which the difference must be below zero
    least_gain: float  # share of the old poses' mean square by which it must be below zero as well

    @property
    def better(self) -> bool:
        """Whether to keep the new poses: they are better by more than chance, and by more than decoding is biased."""
        return self.difference < -self._margin

    @property
    def worse(self) -> bool:
        """The same the other way round."""
        return self.difference > self._margin

    @property
    def _margin(self) -> float:
        return max(self.standard_errors * self.standard_error, self.least_gain * self.before_px**2)


@one_library_thread()
def cross_validate(
    before: Rig,
    after: Rig,
    held_out: HeldOutPixels,
    maps: CoordinateMaps,
    noise_px: float,
    settings: AdjustmentSettings | None = None,
) -> CrossValidation:
    """Compare two sets of poses on the same pixels and the same pairs of frames.

    A residual counts as r^2 / (1 + r^2 / width^2): a wrong decoding costs width^2 with any poses. `noise_px` is the
    decoding noise of one look-up.
    """
    settings = settings or AdjustmentSettings()
    s = settings.cross_validation
    width = max(s.width_noises * noise_px, s.least_width_px)
    generator = torch.Generator().manual_seed(settings.seed)
    sides = [(rig, _anchors(rig, held_out)) for rig in (before, after)]
    together = partners(after, sides[1][1], maps, settings.partners, settings.least_cosine, generator)
    keys = []
    for rig, anchors in sides:
        seen = observe(rig, anchors, maps, s.frames_per_pixel, 2 * width, settings.least_cosine, generator, together)
        keys.append(seen.anchor * rig.frames + seen.frame)
    key = torch.unique(torch.cat(keys))
    rows = Observations(key // before.frames, key % before.frames)
    block = torch.cat([held_out.block, held_out.block[rows.anchor]])
    losses = [_robust_squares(rig, anchors, rows, maps, width) for rig, anchors in sides]
    difference, error = mean_and_error(losses[1] - losses[0], block)
    first, second = (float(loss.mean().sqrt()) for loss in losses)
    return CrossValidation(first, second, difference, error, s.standard_errors, s.least_gain)


def _robust_squares(
    rig: Rig, anchors: Anchors, rows: Observations, maps: CoordinateMaps, width: float
) -> Float[Tensor, "residuals"]:
    """Robust squares of the own residuals, then of the cross residuals; width^2 for those that do not exist."""
    r = residuals_of(rig, anchors, rows, maps)
    own2 = torch.nan_to_num((r.own**2).sum(-1), nan=float("inf"))
    cross2 = torch.where(r.cross_valid, (r.cross**2).sum(-1), torch.full_like(r.cross[:, 0], float("inf")))
    r2 = torch.cat([own2, torch.nan_to_num(cross2, nan=float("inf"))])
    return 1 / (1 / r2.clamp_min(1e-12) + 1 / width**2)


def mean_and_error(values: Float[Tensor, "n"], block: Int[Tensor, "n"]) -> tuple[float, float]:
    """Mean and its standard error, if the values within a block may depend on each other in any way.

    The error of a ratio of sums over blocks (Cochran, Sampling Techniques, 1977, section 6.3).
    """
    mean = values.mean()
    _, index = torch.unique(block, return_inverse=True)
    blocks = int(index.max()) + 1 if len(index) else 0
    if blocks < 2:
        return float(mean), float("inf")
    sums = torch.zeros(blocks, dtype=values.dtype).index_add(0, index, values - mean)
    return float(mean), float((blocks / (blocks - 1) * (sums**2).sum()).sqrt() / len(values))


def _anchors(rig: Rig, held_out: HeldOutPixels) -> Anchors:
    d_camera = unproject(rig.camera[held_out.frame], held_out.uv_camera)
    T = rig.T_camera_projector[held_out.frame]
    d_projector = (T[:, :3, :3] @ unproject(rig.projector, held_out.uv_projector)[..., None]).squeeze(-1)
    depth, _ = closest_approach(torch.zeros_like(d_camera), d_camera, T[:, :3, 3], d_projector)
    # No map surrounds a held-out pixel, so there is no normal; "towards the camera" is accurate enough to choose the
    # frames that see it.
    return Anchors(held_out.frame, d_camera, held_out.uv_projector, torch.nan_to_num(depth, nan=1.0), -d_camera)
