"""The projector's intrinsics from all frames: starts, joint fit, choice of the model, and what is uncertain."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.devices import Device, DeviceChange
from sl_nerfstudio.geometry.numerics import geman_mcclure_cost
from sl_nerfstudio.parallel import one_library_thread
from sl_nerfstudio.relative_pose.candidates import RayCounts, in_front, poses_of
from sl_nerfstudio.relative_pose.epipolar import KERNEL_SIGMAS, RayPairs, UnitPose, sampson_of_frames, subsample
from sl_nerfstudio.relative_pose.estimation import RelativePoseError, estimate_relative_pose
from sl_nerfstudio.relative_pose.joint_fit import (
    CX,
    CY,
    FOCAL_AND_CENTRE,
    K1,
    LOG_ASPECT,
    LOG_FOCAL,
    MOST_MATCHES,
    MOST_PER_FRAME,
    FrameMatches,
    JointFit,
    JointProblem,
    PointMatches,
    device_with,
    values_of,
)

FEWEST_FRAMES = 3  # each has two constraints; three and more are unknown
FEWEST_POSED = 2  # frames with a pose and with depth
FEW_FRAMES = 6  # below, an uncertain result is put down to their number
ALIKE_DEG = 5.0  # angle between relative poses below which frames are alike
ROUNDS = 4  # searches for the poses of all frames, each with the projector found before
SETTLED_SIGMAS = 0.5  # change of the intrinsics in the last round
LARGEST_SIGMA = 0.08  # of focal length or principal point, shares of the focal length; beyond, there is no result
DOUBTFUL_SIGMA = 0.02  # beyond, the result is doubtful
LARGEST_NOISE_SHARE = 0.005  # of the image's width; with more noise no intrinsics fit
POSE_COUNTS = RayCounts(fit=2000, polishing=400, ranking=1500)  # of the search for one frame's pose

# Fundamental matrices and starts.
MOST_IN_FUNDAMENTAL, FEWEST_IN_FUNDAMENTAL = 2000, 50  # correspondences
FUNDAMENTAL_SAMPLES = 2000  # random samples at most
OUTLIER_PX = 1.5  # distance from the epipolar line
FOCAL_WIDTHS = (0.6, 0.8, 1.0, 1.25, 1.5, 1.8, 2.2, 2.7, 3.3, 4.0, 5.0)
CENTRES_X = (0.0, 0.25, 0.5, 0.75, 1.0)  # widths
CENTRES_Y = (-1.0, -0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0)  # heights
STARTS = 6  # places of the grid from which the fit starts
APART = 0.2  # between them: logarithm of the focal length, and principal point in widths
LARGEST_MISFIT = 0.3  # relative difference of an essential matrix's singular values: an outlier
START_MATCHES, START_ITERATIONS = 200, 20  # of each frame; of the fit from each start

# Choice of the model.
CHOICE_MATCHES = 12_000  # correspondences of all frames
FOLDS = 4  # parts of the pattern's squares that are left out in turn
STANDARD_ERRORS = 2.0  # by which left-out squares must agree better for another free parameter

Cause = Literal["few frames", "similar frames", "flat", "unknown"]


@dataclass(frozen=True)
class ProjectorEstimate:
    """Intrinsics with their uncertainty. Those that are not free are as stated, or those of square pixels."""

    projector: Device
    covariance: Float64[ndarray, "5 5"]  # of `joint_fit.NAMES`; zero where not free
    free: tuple[int, ...]
    noise_px: float  # robust standard deviation of the epipolar errors, projector pixels
    frames: tuple[str, ...]  # that were used
    cause: Cause | None  # why it is uncertain; None: it is well determined
    centre_kept: bool  # the principal point is the stated one: the frames do not determine it

    @property
    def sigma(self) -> Float64[ndarray, "5"]:
        """1 sigma of `joint_fit.NAMES`."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True)
class NoProjector:
    """The frames do not determine the projector's intrinsics."""

    cause: Cause
    frames: int  # that could be used
    sigma: float  # of the least certain one, share of the focal length; inf: nothing was found
    noise_px: float


@one_library_thread()
def estimate_projector(
    frames: Sequence[FrameMatches],
    projector: Device,
    stated: bool,
    seed: int = 0,
    camera_sigma: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> ProjectorEstimate | NoProjector:
    """Intrinsics of the projector for which the epipolar errors of all frames together are smallest.

    `projector` gives size and model, and if `stated` a start for the rest. A model without fundamental matrices (DOE)
    needs a stated one. Lens terms other than k1 stay as they are. `camera_sigma`: 1 sigma of the cameras' focal length
    and principal point, as shares of the focal length.
    """
    if len(frames) < FEWEST_FRAMES and not stated:
        return NoProjector("few frames", len(frames), np.inf, np.inf)
    rng, usual = np.random.default_rng(seed), values_of(projector)
    device = _start(frames, projector, stated, rng)
    if device is None:
        return NoProjector("unknown", 0, np.inf, np.inf)
    refined = _refined(frames, device, usual, rng, seed)
    if isinstance(refined, NoProjector):
        return refined
    first, matches, index = refined
    centre_kept = stated and _uncertainty(first) > LARGEST_SIGMA
    if centre_kept:
        found = JointProblem(matches, projector, (LOG_FOCAL,), usual).fit(first.poses)
    else:
        found = choose_model(matches, first, usual)
    doubtful = _uncertainty(found) > DOUBTFUL_SIGMA or len(index) < FEWEST_FRAMES
    cause = _cause(found, len(index), len(frames)) if doubtful else None
    if _uncertainty(found) > LARGEST_SIGMA or found.noise_px > LARGEST_NOISE_SHARE * projector.w:
        return NoProjector(cause or "unknown", len(index), _uncertainty(found), found.noise_px)
    covariance, used = np.zeros((5, 5)), [frames[k] for k in index]
    by_camera = _covariance_by_camera(used, camera_sigma, found, projector, usual, seed)
    covariance[np.ix_(found.free, found.free)] = found.covariance + by_camera
    names = tuple(frame.name for frame in used)
    return ProjectorEstimate(found.device, covariance, found.free, found.noise_px, names, cause, centre_kept)


def _start(frames: Sequence[FrameMatches], projector: Device, stated: bool, rng: np.random.Generator) -> Device | None:
    """A projector with which the frames' poses can be found."""
    if projector.model == "DOE":
        return projector if stated else None
    matches = PointMatches.of(frames, projector, MOST_IN_FUNDAMENTAL, rng)
    found = best_start(matches, projector, stated, rng)
    if found is None:
        return projector if stated else None
    return found.device


def _refined(
    frames: Sequence[FrameMatches], device: Device, usual: Float64[ndarray, "5"], rng: np.random.Generator, seed: int
) -> tuple[JointFit, PointMatches, list[int]] | NoProjector:
    """Fit to all frames with depth, with their correspondences and numbers.

    Poses are searched for anew with every projector found: with a wrong one, flat frames end in the wrong one of their
    two solutions. Frames that show a plane fit any projector; their noise would pass for depth.
    """
    some = [_thinned(frame, rng) for frame in frames]
    found: tuple[JointFit, PointMatches, list[int]] | NoProjector = NoProjector("unknown", 0, np.inf, np.inf)
    for _ in range(ROUNDS):
        posed, firm = _poses_with(some, device, seed)
        if len(firm) < FEWEST_POSED:
            return NoProjector("flat" if posed >= FEWEST_POSED else "unknown", len(firm), np.inf, np.inf)
        index = list(firm)
        matches = _matches([frames[k] for k in index], device, seed)
        fit = JointProblem(matches, device, FOCAL_AND_CENTRE, usual).fit(list(firm.values()))
        change = np.abs(values_of(fit.device) - values_of(device))[list(FOCAL_AND_CENTRE)]
        found, device = (fit, matches, index), fit.device
        if (change < SETTLED_SIGMAS * np.sqrt(np.diag(fit.covariance))).all():
            break
    return found


def _poses_with(frames: Sequence[FrameMatches], projector: Device, seed: int) -> tuple[int, dict[int, UnitPose]]:
    """Count the frames that have a relative pose with a projector; poses of those that show depth, by number."""
    posed, firm = 0, {}
    for k, frame in enumerate(frames):
        try:
            one = estimate_relative_pose(
                frame.uv_camera, frame.uv_projector, frame.camera, projector, seed, POSE_COUNTS
            )
        except RelativePoseError:
            continue
        posed += 1
        if not any(d.kind in ("planar", "pure rotation") for d in one.degeneracies):
            firm[k] = one.T_camera_projector[:3, :3], one.T_camera_projector[:3, 3]
    return posed, firm


def _matches(frames: Sequence[FrameMatches], device: Device, seed: int) -> PointMatches:
    """Draw as many correspondences as the joint fit takes."""
    most = min(MOST_PER_FRAME, max(MOST_MATCHES // len(frames), 1))
    return PointMatches.of(frames, device, most, np.random.default_rng(seed))


def _thinned(frame: FrameMatches, rng: np.random.Generator) -> FrameMatches:
    """The frame with as many correspondences as a first pose needs."""
    keep = subsample(np.arange(len(frame.uv_camera)), POSE_COUNTS.fit, rng)
    return replace(frame, uv_camera=frame.uv_camera[keep], uv_projector=frame.uv_projector[keep])


def _uncertainty(found: JointFit) -> float:
    """The largest sigma of focal length and principal point, as a share of the focal length."""
    widths = found.device.w / found.device.fl_x
    unit = {LOG_FOCAL: 1.0, CX: widths, CY: widths}
    sigma = np.sqrt(np.diag(found.covariance))
    return max(unit[k] * float(s) for k, s in zip(found.free, sigma, strict=True) if k in unit)


def _cause(found: JointFit, used: int, frames: int) -> Cause:
    """The measured cause of an uncertain focal length."""
    R, t = Rotation.from_matrix([R for R, _ in found.poses]), np.stack([t for _, t in found.poses])
    turns = np.degrees((R * R[0].inv()).magnitude())
    swings = np.degrees(np.arccos((t @ t[0]).clip(-1, 1)))
    if used > 1 and max(float(turns.max()), float(swings.max())) < ALIKE_DEG:
        return "similar frames"
    if 2 * used < frames:
        return "flat"
    return "few frames" if used < FEW_FRAMES else "unknown"


def _covariance_by_camera(
    frames: Sequence[FrameMatches],
    camera_sigma: tuple[float, float, float],
    found: JointFit,
    projector: Device,
    usual: Float64[ndarray, "5"],
    seed: int,
) -> Float64[ndarray, "free free"]:
    """What uncertain cameras add to the covariance of the free intrinsics: how far these follow a change by 1 sigma.

    A Gauss-Newton step shows how far; what is left of it with the cameras as they are does not count.
    """

    def step(change: DeviceChange) -> Float64[ndarray, "free"]:
        moved = [replace(frame, camera=change.applied(frame.camera)) for frame in frames]
        problem = JointProblem(_matches(moved, projector, seed), found.device, found.free, usual)
        return problem.gauss_newton_step(found.poses)

    total = np.zeros((len(found.free), len(found.free)))
    if any(camera_sigma):
        usually = step(DeviceChange(0.0, 0.0, 0.0))
        for row in np.diag(camera_sigma)[np.greater(camera_sigma, 0)]:
            effect = step(DeviceChange(*row.tolist())) - usually
            total += np.outer(effect, effect)
    return total


# First solutions from fundamental matrices, and the intrinsics of the projector that make essential matrices of them.
#
# Rays of the camera are points (x / z, y / z, 1) in its own axes, where both devices look along -z; `F` satisfies
# `d_camera^T F (u, v, 1) = 0`. `F K` is an essential matrix with the right K: its two singular values are equal
# (Kruppa's equations, one camera known: Hartley, Extraction of focal lengths from the fundamental matrix, 1993).


def best_start(matches: PointMatches, projector: Device, stated: bool, rng: np.random.Generator) -> JointFit | None:
    """Focal length and principal point that fit a small part of the correspondences best.

    Frames without a fundamental matrix are left out. None if too few have one, or none of the starts converges.
    """
    F = [fundamental_matrix(matches, k, projector) for k in range(matches.frames)]
    index = [k for k, one in enumerate(F) if one is not None]
    known = [one for one in F if one is not None]
    if len(known) < 2:
        return None
    some = _thinned_matches(matches, index, rng)
    log_w, usual = np.log(projector.w), values_of(projector)
    places = grid_starts(known, projector)
    devices = [device_with(projector, [np.log(f) + log_w, 0.0, x, y, projector.k1]) for f, x, y in places]
    fits = []
    for device in (projector, *devices) if stated else devices:
        rays = some.rays(device)
        poses = [pose_of_fundamental(one, device, rays.chosen(some.of_frame(k))) for k, one in enumerate(known)]
        fits.append(JointProblem(some, device, FOCAL_AND_CENTRE, usual).fit(poses, START_ITERATIONS))
    # Compared at the width of the best noise: a fit that gives up half of the pixels must not win.
    noise = min(fit.noise_px for fit in fits)
    return min(fits, key=lambda fit: float(_losses(some, fit, noise).mean()))


def _losses(matches: PointMatches, fit: JointFit, noise_px: float) -> Float64[ndarray, "n"]:
    """Robust cost of every correspondence."""
    R, t = np.stack([R for R, _ in fit.poses]), np.stack([t for _, t in fit.poses])
    r = np.nan_to_num(sampson_of_frames(R, t, matches.rays(fit.device), matches.frame), nan=1e6)
    return geman_mcclure_cost((r / (KERNEL_SIGMAS * noise_px)).clip(-1e6, 1e6) ** 2)


def _thinned_matches(matches: PointMatches, index: Sequence[int], rng: np.random.Generator) -> PointMatches:
    """Some correspondences of some frames, which are numbered anew."""
    rows = [np.arange(*matches.of_frame(k).indices(len(matches.frame))) for k in index]
    rows = [r if len(r) <= START_MATCHES else np.sort(rng.choice(r, START_MATCHES, replace=False)) for r in rows]
    some = matches.chosen(np.concatenate(rows))
    return replace(some, frame=np.searchsorted(index, some.frame), frames=len(index))


def fundamental_matrix(matches: PointMatches, k: int, projector: Device) -> Float64[ndarray, "3 3"] | None:
    """The fundamental matrix of frame `k`, in units of the projector's width; None where there is none."""
    part = matches.of_frame(k)
    d, uv = matches.d_camera[part][:MOST_IN_FUNDAMENTAL], matches.uv_projector[part][:MOST_IN_FUNDAMENTAL]
    if len(d) < FEWEST_IN_FUNDAMENTAL:
        return None
    scale = projector.w  # so that both images are of similar size for the distance of outliers
    camera = d[:, :2] / d[:, 2:]
    spread = scale * float(np.ptp(uv, axis=0).max() / scale) / max(float(np.ptp(camera, axis=0).max()), 1e-9)
    F, _ = cv2.findFundamentalMat(uv, spread * camera, cv2.USAC_MAGSAC, OUTLIER_PX, 0.9999, FUNDAMENTAL_SAMPLES)
    if F is None or F.shape != (3, 3):
        return None
    return np.diag([spread, spread, 1.0]) @ F @ np.diag([scale, scale, 1.0])


def grid_starts(F: Sequence[Float64[ndarray, "3 3"]], projector: Device) -> list[tuple[float, float, float]]:
    """Focal length and principal point in widths, the most promising first: places of the grid, apart from each other.

    The misfit of a frame is the relative difference of the two singular values, at most that of an outlier.
    """
    heights = projector.h / projector.w
    places = np.array([(f, x, y * heights) for f, x, y in product(FOCAL_WIDTHS, CENTRES_X, CENTRES_Y)])
    K = np.zeros((len(places), 3, 3))
    K[:, 0, 0], K[:, 1, 1], K[:, 2, 2] = -places[:, 0], places[:, 0], 1
    K[:, 0, 2], K[:, 1, 2] = places[:, 1], places[:, 2]
    misfit = np.zeros(len(places))
    for one in F:
        s = np.linalg.svd(one @ K, compute_uv=False)
        misfit += np.minimum((1 - s[:, 1] / s[:, 0]) / LARGEST_MISFIT, 1) ** 2
    kept: list[tuple[float, float, float]] = []
    for place in places[np.argsort(misfit, kind="stable")]:
        if all(_apart(place, other) for other in kept):
            kept.append((float(place[0]), float(place[1]), float(place[2])))
        if len(kept) >= STARTS:
            break
    return kept


def _apart(a: Sequence[float] | ndarray, b: Sequence[float] | ndarray) -> bool:
    return bool(max(abs(np.log(a[0] / b[0])), abs(a[1] - b[1]), abs(a[2] - b[2])) > APART)


def pose_of_fundamental(F: Float64[ndarray, "3 3"], projector: Device, rays: RayPairs) -> UnitPose:
    """The pose nearest to a fundamental matrix with most rays meeting in front of both devices."""
    w = projector.w
    # From (x / z, y / z, 1) in the projector's axes to pixels in units of the image's width.
    K = np.array([[-projector.fl_x / w, 0, projector.cx / w], [0, projector.fl_y / w, projector.cy / w], [0, 0, 1.0]])
    return max(poses_of(F @ K), key=lambda pose: int(in_front(*pose, rays).sum()))


# Which intrinsics are free: another one is, if left-out correspondences agree better with it.

_FURTHER = (LOG_ASPECT, K1)


def choose_model(matches: PointMatches, first: JointFit, usual: Float64[ndarray, "5"]) -> JointFit:
    """`first`, or a fit with aspect, distortion or both free.

    Squares of the pattern are left out in turns (k-fold cross-validation), because errors within one depend on each
    other. The smallest model remains unless a larger one agrees better by some standard errors; of several, the one
    that agrees best.
    """
    some = matches.chosen(np.arange(len(matches.frame)) % (1 + len(matches.frame) // CHOICE_MATCHES) == 0)
    further = _significant(some, first, usual)
    candidates = {
        tuple(sorted((*first.free, *extra))) for n in range(1, len(further) + 1) for extra in combinations(further, n)
    }
    base = _left_out(some, first, first.free, usual) if candidates else np.zeros(0)
    gains = [(*_gain(base, _left_out(some, first, one, usual), some), one) for one in sorted(candidates)]
    good = [(total, one) for total, error, one in gains if total > STANDARD_ERRORS * error]
    return JointProblem(matches, first.device, max(good)[1], usual).fit(first.poses) if good else first


def _significant(matches: PointMatches, first: JointFit, usual: Float64[ndarray, "5"]) -> tuple[int, ...]:
    """Further intrinsics that depart from their usual values by some standard deviations, if all are free.

    The others cannot improve left-out correspondences by more than chance.
    """
    problem = JointProblem(matches, first.device, (*first.free, *_FURTHER), usual)
    found = problem.fit(first.poses)
    away = np.abs(values_of(found.device) - values_of(first.device))[list(_FURTHER)]
    sigma = np.sqrt(np.diag(found.covariance))[len(first.free) :]
    return tuple(k for k, far in zip(_FURTHER, away > STANDARD_ERRORS * sigma, strict=True) if far)


def _left_out(
    matches: PointMatches, first: JointFit, free: tuple[int, ...], usual: Float64[ndarray, "5"]
) -> Float64[ndarray, "n"]:
    """Robust cost of every correspondence under the fit to the others."""
    fold = np.unique(matches.block, return_inverse=True)[1] * 7919 % FOLDS
    out = np.zeros(len(matches.frame))
    for k in range(FOLDS):
        problem = JointProblem(matches.chosen(fold != k), first.device, free, usual)
        found = problem.fit(first.poses)
        out[fold == k] = _losses(matches.chosen(fold == k), found, first.noise_px)
    return out


def _gain(base: Float64[ndarray, "n"], other: Float64[ndarray, "n"], matches: PointMatches) -> tuple[float, float]:
    """Gain in cost by the other model, and its standard error; squares are independent."""
    _, block = np.unique(matches.block, return_inverse=True)
    sums = np.bincount(block, base - other)
    return float(sums.sum()), float(np.sqrt((sums**2).sum()))
