"""Bundle adjustment of all cameras and projectors from decoded coordinates.

Levenberg-Marquardt with a Geman-McClure kernel whose width shrinks from the size of the starting errors to the size of
the noise (graduated non-convexity: Yang et al., RA-L 2020), priors from the stated uncertainty of the starting poses,
and a fixed gauge. See `residuals` for what is minimised, and docs/method.md for why this happens before volume
rendering.
"""

from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.covariance import CovarianceEvidence, gauge_free, pose_covariance
from sl_nerfstudio.bundle_adjustment.modes import Explored, Mode, explore, with_others
from sl_nerfstudio.bundle_adjustment.observations import NOISE_FLOOR_PX, observe, partners
from sl_nerfstudio.bundle_adjustment.parameters import (
    UNKNOWNS,
    FreeParameters,
    PosePrior,
    RefinePoses,
    SelfCalibration,
    free_parameters,
    linearise_with_intrinsics,
    prior_equations,
    with_derivatives_along_surface,
    with_smooth_derivatives,
)
from sl_nerfstudio.bundle_adjustment.posterior import mean_and_error, odds
from sl_nerfstudio.bundle_adjustment.residuals import Anchors, Observations, Rig, linearise, residuals_of
from sl_nerfstudio.bundle_adjustment.search import (
    FRAMES_MOVE,
    LEAST_COSINE,
    PARTNERS,
    AdjustmentSettings,
    SearchProblem,
    SearchProgress,
    along_surface,
    kernel_of,
    problem_of,
    search,
    with_more_anchors,
)
from sl_nerfstudio.geometry.devices import unproject
from sl_nerfstudio.geometry.triangulation import closest_approach
from sl_nerfstudio.parallel import one_library_thread


@dataclass(frozen=True)
class Adjustment:
    """Poses of all devices with their covariance, in the scene, and how well they agree with the captures."""

    rig: Rig
    factor: Float[Tensor, "joint k"]  # of the covariance of (delta, rho, intrinsics) without the gauge
    intrinsics: SelfCalibration | None  # None where nothing was adjusted
    noise_px: float  # estimated noise of one look-up, projector pixels
    iterations: int
    median_before_px: float
    median_after_px: float
    unplaced: tuple[int, ...]  # frames that do not agree with the others: neither their poses nor their sigma hold
    start: Rig  # to which the prior belongs: the given one, but for frames whose starting pose proved to be wrong
    modes: tuple[Mode, ...] = ()  # other poses that remain possible, the most probable first
    explored: Explored | None = field(default=None, repr=False)  # None: the covariance includes other minima

    @property
    def covariance(self) -> Float[Tensor, "unknowns unknowns"]:
        """Covariance of (delta, rho) alone."""
        return self.factor[:-UNKNOWNS] @ self.factor[:-UNKNOWNS].T

    @property
    def sigma(self) -> Float[Tensor, "frames 12"]:
        """1 sigma of each frame's delta and rho: translation xyz, rotation xyz each."""
        sigma = self.factor[:-UNKNOWNS].norm(dim=1)
        return sigma.reshape(2, self.rig.frames, 6).transpose(0, 1).flatten(1)


def adjust(
    start: Rig, maps: CoordinateMaps, prior: PosePrior, refine: RefinePoses, settings: AdjustmentSettings
) -> Adjustment:
    """Adjust all poses together. The scene must be normalised: origin at the object's centre, radius about one.

    The gauge stays where the prior puts it; `restore` sets the scale afterwards. Frames that share nothing with others
    do not move.
    """
    return with_other_minima(find_minimum(start, maps, prior, refine, settings))


@one_library_thread()
def find_minimum(
    start: Rig, maps: CoordinateMaps, prior: PosePrior, refine: RefinePoses, settings: AdjustmentSettings
) -> Adjustment:
    """Adjust all poses together without asking for other minima, for results that may be replaced by later ones."""
    problem = problem_of(start, maps, prior, settings)
    first = search(problem, refine)
    if first is None:
        return _unmoved(start, prior, free_parameters(refine, start))
    moves = refine in FRAMES_MOVE
    found = explore(problem, refine, _likelier(problem, refine, first[0]) if moves else first[0])
    if moves:
        found = replace(found, best=with_more_anchors(found.problem, refine, found.best))
    return replace(_result(found, first[1]), explored=found)


def _likelier(problem: SearchProblem, refine: RefinePoses, first: SearchProgress) -> SearchProgress:
    """The end of a search, or where more steps along the surface lead, if that is more probable."""
    end = along_surface(problem, refine, first)
    better = odds(problem, end.state.rig, first.state.rig, min(end.noise, first.noise)).better
    return end if better else first


@one_library_thread()
def with_other_minima(found: Adjustment) -> Adjustment:
    """Let the covariance and the modes cover other minima, if the poses are one of several; the poses stay."""
    if found.explored is None:
        return found
    factor, modes = with_others(found.explored, found.factor, found.unplaced)
    return replace(found, factor=factor, modes=modes, explored=None)


def _result(explored: Explored, before: float) -> Adjustment:
    """Poses with their covariance; all residuals have full weight, whichever stage the steps ended in."""
    problem, found = explored.problem, explored.best
    state, maps = found.state, problem.maps
    scene = state.rig, state.anchors, found.rows, maps
    exact = linearise_with_intrinsics(linearise(*scene), *scene)
    smooth, along = with_smooth_derivatives(exact, *scene), with_derivatives_along_surface(*scene)
    r = exact.residuals
    kernel = kernel_of(state, found.rows, found.widths, r)
    inliers = r.cross_valid & (r.cross.norm(dim=-1) < 4 * kernel.narrowest)
    evidence = CovarianceEvidence(state.rig, state.anchors, found.rows, exact, smooth, along, kernel)
    free = free_parameters(explored.refine, state.rig)
    factor, intrinsics = pose_covariance(evidence, free, problem.start, problem.prior, found.noise)
    return Adjustment(
        rig=state.rig,
        factor=factor,
        intrinsics=intrinsics,
        noise_px=found.noise,
        iterations=found.iterations,
        median_before_px=before,
        median_after_px=float(r.cross[inliers].norm(dim=-1).median()),
        unplaced=explored.unplaced,
        start=problem.start,
    )


def _unmoved(start: Rig, prior: PosePrior, free: FreeParameters) -> Adjustment:
    """The starting poses with the prior's uncertainty, if no step is allowed or no frame sees what another decoded."""
    H, _ = prior_equations(prior, start, start)
    nan = float("nan")
    factor = torch.block_diag(gauge_free(start, free, H), prior.intrinsics_sigma.diag())
    return Adjustment(start, factor, None, NOISE_FLOOR_PX, 0, nan, nan, (), start)


# Cross-validation: pixels that took no part in the adjustment decide whether its poses are kept, by a paired
# comparison. Each held-out pixel has the same residuals under both sets of poses. So the mean of their differences is
# compared with zero, rather than two means with each other. Residuals within a small block of an image depend on each
# other: blocks are the independent samples from which the standard error follows.

HELD_OUT_PER_FRAME = 300  # held-out pixels of each frame, at most
_FRAMES_PER_PIXEL = 8  # other frames in which each of them is looked up, at most
_WIDTH_NOISES, _LEAST_WIDTH_PX = 4.0, 0.25  # width of the robust kernel; looking up between pixels is never perfect
_STANDARD_ERRORS = 2.0  # by which the mean paired difference must be below zero for a change to be kept
LEAST_VALIDATED_GAIN = 0.01  # share of the mean robust square by which it must be below zero as well if poses are to be
# kept: held-out pixels share systematic errors of decoding with the others, which standard errors do not show


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
    least_gain: float  # share of the old poses' mean square by which it must be below zero as well

    @property
    def better(self) -> bool:
        """Whether to keep the new poses: they are better by more than chance, and by more than decoding is biased."""
        return self.difference < -self._margin

    @property
    def worse(self) -> bool:
        """Whether the new poses are worse by as much."""
        return self.difference > self._margin

    @property
    def _margin(self) -> float:
        return max(_STANDARD_ERRORS * self.standard_error, self.least_gain * self.before_px**2)


@one_library_thread()
def cross_validate(
    before: Rig,
    after: Rig,
    held_out: HeldOutPixels,
    maps: CoordinateMaps,
    noise_px: float,
    least_gain: float = LEAST_VALIDATED_GAIN,
) -> CrossValidation:
    """Compare two sets of poses on the same pixels and the same pairs of frames.

    A residual counts as r^2 / (1 + r^2 / width^2): a wrong decoding costs width^2 with any poses. `noise_px` is the
    decoding noise of one look-up.
    """
    width, generator = max(_WIDTH_NOISES * noise_px, _LEAST_WIDTH_PX), torch.Generator().manual_seed(0)
    sides = [(rig, _anchors(rig, held_out)) for rig in (before, after)]
    together = partners(after, sides[1][1], maps, PARTNERS, LEAST_COSINE, generator)
    keys = []
    for rig, anchors in sides:
        seen = observe(rig, anchors, maps, _FRAMES_PER_PIXEL, 2 * width, LEAST_COSINE, generator, together)
        keys.append(seen.anchor * rig.frames + seen.frame)
    key = torch.unique(torch.cat(keys))
    rows = Observations(key // before.frames, key % before.frames)
    block = torch.cat([held_out.block, held_out.block[rows.anchor]])
    losses = [_robust_squares(rig, anchors, rows, maps, width) for rig, anchors in sides]
    difference, error = mean_and_error(losses[1] - losses[0], block)
    first, second = (float(loss.mean().sqrt()) for loss in losses)
    return CrossValidation(first, second, difference, error, least_gain)


def _robust_squares(
    rig: Rig, anchors: Anchors, rows: Observations, maps: CoordinateMaps, width: float
) -> Float[Tensor, "residuals"]:
    """Robust squares of the own residuals, then of the cross residuals; width^2 for those that do not exist."""
    r = residuals_of(rig, anchors, rows, maps)
    own2 = torch.nan_to_num((r.own**2).sum(-1), nan=float("inf"))
    cross2 = torch.where(r.cross_valid, (r.cross**2).sum(-1), torch.full_like(r.cross[:, 0], float("inf")))
    r2 = torch.cat([own2, torch.nan_to_num(cross2, nan=float("inf"))])
    return 1 / (1 / r2.clamp_min(1e-12) + 1 / width**2)


def _anchors(rig: Rig, held_out: HeldOutPixels) -> Anchors:
    d_camera = unproject(rig.camera[held_out.frame], held_out.uv_camera)
    T = rig.T_camera_projector[held_out.frame]
    d_projector = (T[:, :3, :3] @ unproject(rig.projector, held_out.uv_projector)[..., None]).squeeze(-1)
    depth, _ = closest_approach(torch.zeros_like(d_camera), d_camera, T[:, :3, 3], d_projector)
    # No map surrounds a held-out pixel, so there is no normal; "towards the camera" is accurate enough to choose the
    # frames that see it. Nor is there a roughness.
    depth = torch.nan_to_num(depth, nan=1.0)
    return Anchors(held_out.frame, d_camera, held_out.uv_projector, depth, -d_camera, torch.full_like(depth, torch.nan))
