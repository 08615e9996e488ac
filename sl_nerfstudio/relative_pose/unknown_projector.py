"""The projector's intrinsics from all frames: starts, joint fit, choice of the model, and what is uncertain."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, product
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.devices import Device, DeviceChange
from sl_nerfstudio.geometry.numerics import MAD_TO_SIGMA, geman_mcclure_cost, geman_mcclure_weight
from sl_nerfstudio.parallel import one_library_thread
from sl_nerfstudio.relative_pose.candidates import in_front
from sl_nerfstudio.relative_pose.epipolar import (
    CandidateSettings,
    PatternBlocks,
    RayPairs,
    RelativePoseSettings,
    blocks_of,
    directions,
    directions_by_uv,
    moved,
    sampson_jacobian,
    sampson_of_frames,
    subsample,
)
from sl_nerfstudio.relative_pose.estimation import RelativePoseError, estimate_relative_pose

# Settings of the search for a projector's intrinsics.


@dataclass(frozen=True)
class IntrinsicsPrior:
    """What is known of any projector before the first frame is looked at: 1 sigma around the start."""

    log_focal: float = 0.7
    """logarithm of the focal length"""
    log_aspect: float = 0.1
    """logarithm of fl_y over fl_x: keystone correction and scaling change it"""
    cx: float = 0.5
    """principal point to the right, widths of the image"""
    cy: float = 1.0
    """principal point downward, widths of the image: lens shift moves it far outside"""
    k1: float = 0.1
    """radial distortion"""


@dataclass(frozen=True)
class GridSettings:
    """Intrinsics from which the search starts."""

    focal_widths: tuple[float, ...] = (0.6, 0.8, 1.0, 1.25, 1.5, 1.8, 2.2, 2.7, 3.3, 4.0, 5.0)
    """focal lengths, widths of the image"""
    centre_x: tuple[float, ...] = (0.0, 0.25, 0.5, 0.75, 1.0)
    """principal points, widths of the image"""
    centre_y: tuple[float, ...] = (-1.0, -0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0)
    """principal points, heights of the image"""
    starts: int = 6
    """places of the grid from which the fit starts"""
    apart: float = 0.2
    """distance between them at least: logarithm of the focal length, and principal point in widths"""
    largest_misfit: float = 0.3
    """relative difference of an essential matrix's two singular values at which a frame counts as an outlier"""


@dataclass(frozen=True)
class FundamentalSettings:
    """The fundamental matrix of each frame."""

    most: int = 2000
    """correspondences at most"""
    outlier_px: float = 1.5
    """distance from the epipolar line, in pixels, within which a correspondence is an inlier"""
    samples: int = 2000
    """random samples at most"""
    fewest: int = 50
    """correspondences with which a fundamental matrix is looked for"""


@dataclass(frozen=True)
class JointFitSettings:
    """Levenberg-Marquardt on intrinsics and all relative poses."""

    most: int = 40000
    """correspondences of all frames together, at most"""
    most_per_frame: int = 3000
    """the same of one frame"""
    difference_step: float = 1e-5
    """step of the differences by the intrinsics"""
    iterations: int = 40
    """iterations at most"""
    converged: float = 1e-7
    """size of a step below which the fit has converged"""
    least_gain: float = 1e-6
    """share of the cost that a step must gain for the fit to go on"""
    kernel_sigmas: float = 3.0
    """width of the robust kernel, in standard deviations of the residuals"""
    noise_floor_px: float = 1e-3
    """noise that is assumed at least, in projector pixels"""
    damping: float = 1e-4
    """damping of the first step, relative to the diagonal of the normal equations"""
    damping_factor: float = 8.0
    """factor by which the damping falls after a good step and rises after a bad one"""
    tries: int = 8
    """dampings that are tried before the fit ends"""
    largest_step: float = 0.3
    """step of the intrinsics at most; principal points in widths"""


@dataclass(frozen=True)
class UnknownProjectorSettings:
    """All settings of the search."""

    fewest_frames: int = 3
    """frames with two constraints each on three unknowns and more"""
    fewest_posed: int = 2
    """frames with a pose and with depth that a fit needs"""
    few_frames: int = 6
    """frames below which an uncertain result is put down to their number"""
    alike_deg: float = 5.0
    """angle between relative poses below which frames are alike"""
    rounds: int = 4
    """searches for the poses of all frames, each with the projector found before, at most"""
    settled: float = 0.5
    """standard deviations by which the intrinsics may change in the last round"""
    start_iterations: int = 20
    """iterations from each start"""
    start_most: int = 200
    """correspondences of each frame with which the starts are compared"""
    choice_most: int = 12000
    """correspondences of all frames with which models are compared"""
    fold_iterations: int = 6
    """iterations of each fit to the others, from the fit to all"""
    folds: int = 4
    """parts of the pattern's squares that are left out in turn to choose the model"""
    standard_errors: float = 2.0
    """standard errors by which left-out squares must agree better for another free parameter"""
    largest_sigma: float = 0.08
    """standard deviation of focal length or principal point, shares of the focal length, beyond which there is no
    result"""
    doubtful_sigma: float = 0.02
    """the same beyond which the result is doubtful"""
    largest_noise_share: float = 0.005
    """noise, as a share of the image's width, beyond which no intrinsics fit"""
    check_most: int = 20000
    """correspondences of all frames with which stated intrinsics are tested"""
    contradiction: float = 30.0
    """chi square (three degrees of freedom) above which the frames contradict stated intrinsics: chance alone exceeds
    it once in a million, but the errors of squares and frames are not quite independent"""
    least_change: float = 0.01
    """share of the focal length by which stated intrinsics must be wrong to be reported: real lenses and decoders err
    by up to 0.3 % in ways that no sigma of two frames includes"""
    explained: float = 16.0
    """chi square (one or two degrees of freedom) that may remain where a part of the intrinsics explains it all"""
    prior: IntrinsicsPrior = field(default_factory=IntrinsicsPrior)
    """what is known of any projector"""
    grid: GridSettings = field(default_factory=GridSettings)
    """starts"""
    fundamental: FundamentalSettings = field(default_factory=FundamentalSettings)
    """fundamental matrices"""
    fit: JointFitSettings = field(default_factory=JointFitSettings)
    """joint fit"""
    pose: RelativePoseSettings = field(
        default_factory=lambda: RelativePoseSettings(
            most=2000, candidates=CandidateSettings(polishing_rays=400, ranking_rays=1500)
        )
    )
    """search for one frame's pose"""
    blocks: PatternBlocks = field(default_factory=PatternBlocks)
    """squares of the pattern"""


UNKNOWN_PROJECTOR_DEFAULTS = UnknownProjectorSettings()

# The projector's intrinsics as a vector: logarithms of focal length and aspect, principal point in widths, k1.

NAMES = ("log_focal", "log_aspect", "cx", "cy", "k1")
LOG_FOCAL, LOG_ASPECT, CX, CY, K1 = range(len(NAMES))


def values_of(device: Device) -> Float64[ndarray, "5"]:
    """The vector of a device."""
    return np.array(
        [np.log(device.fl_x), np.log(device.fl_y / device.fl_x), device.cx / device.w, device.cy / device.w, device.k1]
    )


def device_with(device: Device, values: Sequence[float] | Float64[ndarray, "5"]) -> Device:
    """A device of the same image and model with other values; k2, p1, p2 stay."""
    focal = float(np.exp(values[LOG_FOCAL]))
    return replace(
        device,
        fl_x=focal,
        fl_y=focal * float(np.exp(values[LOG_ASPECT])),
        cx=float(values[CX]) * device.w,
        cy=float(values[CY]) * device.w,
        k1=float(values[K1]),
    )


def prior_sigma(prior: IntrinsicsPrior) -> Float64[ndarray, "5"]:
    """1 sigma of the vector."""
    return np.array([getattr(prior, name) for name in NAMES])


# Correspondences of all frames in one array, and their residuals for one projector and all relative poses.

UnitPose = tuple[Float64[ndarray, "3 3"], Float64[ndarray, "3"]]  # R and unit t, projector to camera


@dataclass(frozen=True)
class FrameMatches:
    """Correspondences of one frame, and its camera."""

    name: str
    uv_camera: Float64[ndarray, "n 2"]
    uv_projector: Float64[ndarray, "n 2"]
    camera: Device


@dataclass(frozen=True)
class PointMatches:
    """Correspondences of all frames, frame after frame."""

    d_camera: Float64[ndarray, "n 3"]
    uv_projector: Float64[ndarray, "n 2"]
    frame: Int64[ndarray, "n"]
    block: Int64[ndarray, "n"]  # frame and square of the pattern; errors within one may depend on each other
    frames: int

    @staticmethod
    def of(
        frames: Sequence[FrameMatches], projector: Device, blocks: PatternBlocks, most: int, rng: np.random.Generator
    ) -> "PointMatches":
        """At most `most` correspondences of each frame, by chance."""
        d_camera, uv_projector, number, block = [], [], [], []
        for k, frame in enumerate(frames):
            d = directions(frame.camera, frame.uv_camera)
            usable = np.flatnonzero(np.isfinite(d).all(-1) & np.isfinite(frame.uv_projector).all(-1))
            if len(usable) > most:
                usable = np.sort(rng.choice(usable, most, replace=False))
            uv = frame.uv_projector[usable]
            d_camera.append(d[usable])
            uv_projector.append(uv)
            number.append(np.full(len(usable), k))
            block.append(k * 1_000_000 + blocks_of(uv, projector, blocks))
        rays, uv, number, block = (np.concatenate(part) for part in (d_camera, uv_projector, number, block))
        return PointMatches(rays, uv, number, block, len(frames))

    def chosen(self, keep: Bool[ndarray, "n"]) -> "PointMatches":
        """Some of the correspondences, of the same frames."""
        parts = (self.d_camera[keep], self.uv_projector[keep], self.frame[keep], self.block[keep])
        return PointMatches(*parts, self.frames)

    def of_frame(self, k: int) -> slice:
        """Where a frame's correspondences are."""
        return slice(*np.searchsorted(self.frame, [k, k + 1]).tolist())

    def rays(self, projector: Device) -> RayPairs:
        """The rays with a projector; those that have none are NaN."""
        return RayPairs(self.d_camera, *directions_by_uv(projector, self.uv_projector), self.block)

    def residuals(self, poses: "Poses", rays: RayPairs) -> Float64[ndarray, "n"]:
        """Distances of the coordinates from their epipolar curves, in projector pixels, as in `sampson`."""
        return sampson_of_frames(poses.R, poses.t, rays, self.frame)


@dataclass(frozen=True)
class Poses:
    """Relative poses of all frames, baseline one."""

    R: Float64[ndarray, "frames 3 3"]  # projector to camera
    t: Float64[ndarray, "frames 3"]

    @staticmethod
    def of(poses: Sequence[UnitPose]) -> "Poses":
        """From single poses."""
        return Poses(np.stack([R for R, _ in poses]), np.stack([t for _, t in poses]))

    def chosen(self, keep: Sequence[int] | Int64[ndarray, "m"]) -> "Poses":
        """Of some frames."""
        return replace(self, R=self.R[keep], t=self.t[keep])


# Fundamental matrices, and the intrinsics of the projector that make essential matrices of them.
#
# Rays of the camera are points (x / z, y / z, 1) in its own axes, where both devices look along -z; `F` satisfies
# `d_camera^T F (u, v, 1) = 0`. `F K` is an essential matrix with the right K: its two singular values are equal
# (Kruppa's
# equations, one camera known: Hartley, Extraction of focal lengths from the fundamental matrix, 1993).


def fundamental_matrix(
    matches: PointMatches, k: int, projector: Device, settings: FundamentalSettings
) -> Float64[ndarray, "3 3"] | None:
    """The fundamental matrix of frame `k`, in units of the projector's width; None where there is none."""
    part = matches.of_frame(k)
    d, uv = matches.d_camera[part][: settings.most], matches.uv_projector[part][: settings.most]
    if len(d) < settings.fewest:
        return None
    scale = projector.w  # so that both images are of similar size for the distance of outliers
    camera = d[:, :2] / d[:, 2:]
    spread = scale * float(np.ptp(uv, axis=0).max() / scale) / max(float(np.ptp(camera, axis=0).max()), 1e-9)
    F, _ = cv2.findFundamentalMat(uv, spread * camera, cv2.USAC_MAGSAC, settings.outlier_px, 0.9999, settings.samples)
    if F is None or F.shape != (3, 3):
        return None
    return np.diag([spread, spread, 1.0]) @ F @ np.diag([scale, scale, 1.0])


def calibration_matrix(device: Device) -> Float64[ndarray, "3 3"]:
    """From (x / z, y / z, 1) in the device's axes to pixels in units of the image's width."""
    w = device.w
    return np.array([[-device.fl_x / w, 0, device.cx / w], [0, device.fl_y / w, device.cy / w], [0, 0, 1.0]])


def grid_starts(
    F: Sequence[Float64[ndarray, "3 3"]], projector: Device, settings: GridSettings
) -> list[tuple[float, float, float]]:
    """Focal length and principal point in widths, the most promising first: places of the grid, apart from each other.

    The misfit of a frame is the relative difference of the two singular values, at most that of an outlier.
    """
    heights = projector.h / projector.w
    places = np.array(
        [(f, x, y * heights) for f, x, y in product(settings.focal_widths, settings.centre_x, settings.centre_y)]
    )
    K = np.zeros((len(places), 3, 3))
    K[:, 0, 0], K[:, 1, 1], K[:, 2, 2] = -places[:, 0], places[:, 0], 1
    K[:, 0, 2], K[:, 1, 2] = places[:, 1], places[:, 2]
    misfit = np.zeros(len(places))
    for one in F:
        s = np.linalg.svd(one @ K, compute_uv=False)
        misfit += np.minimum((1 - s[:, 1] / s[:, 0]) / settings.largest_misfit, 1) ** 2
    kept: list[tuple[float, float, float]] = []
    for place in places[np.argsort(misfit, kind="stable")]:
        if all(_apart(place, other, settings.apart) for other in kept):
            kept.append((float(place[0]), float(place[1]), float(place[2])))
        if len(kept) >= settings.starts:
            break
    return kept


def _apart(a: Sequence[float] | ndarray, b: Sequence[float] | ndarray, least: float) -> bool:
    return bool(max(abs(np.log(a[0] / b[0])), abs(a[1] - b[1]), abs(a[2] - b[2])) > least)


def pose_of_fundamental(F: Float64[ndarray, "3 3"], projector: Device, rays: RayPairs) -> UnitPose:
    """The pose nearest to a fundamental matrix with most rays meeting in front of both devices."""
    R1, R2, t = cv2.decomposeEssentialMat(F @ calibration_matrix(projector))
    poses = [(R, s * t[:, 0] / np.linalg.norm(t)) for R in (R1, R2) for s in (1.0, -1.0)]
    return max(poses, key=lambda pose: int(in_front(*pose, rays).sum()))


# Robust fit of the projector's intrinsics together with the relative poses of all frames.
#
# Each frame's five unknowns are eliminated (Schur complement), so that the equations have the size of the
# intrinsics.


@dataclass(frozen=True)
class Prior:
    """Intrinsics that are expected, and 1 sigma of each: see `parameters`."""

    mean: Float64[ndarray, "5"]
    sigma: Float64[ndarray, "5"]


@dataclass(frozen=True)
class JointFit:
    """Intrinsics and poses for which the coordinates lie nearest to their epipolar curves."""

    projector: Device
    poses: Poses
    free: tuple[int, ...]  # which of the intrinsics
    noise_px: float  # robust standard deviation of the residuals
    cost: float  # mean robust cost at the width of the last step, and what the prior adds
    covariance: Float64[ndarray, "free free"]


@dataclass(frozen=True)
class _State:
    values: Float64[ndarray, "5"]
    poses: Poses


@dataclass(frozen=True)
class _Reduced:
    """Normal equations of the intrinsics, with what the poses follow by."""

    H: Float64[ndarray, "free free"]
    g: Float64[ndarray, "free"]
    pose_step: Float64[ndarray, "frames 5"]  # while the intrinsics stay
    pose_slope: Float64[ndarray, "frames 5 free"]  # how poses follow the intrinsics
    scores: Float64[ndarray, "blocks free"]  # gradients of each block, poses eliminated


class JointProblem:
    """One choice of free intrinsics, for given correspondences."""

    def __init__(
        self, matches: PointMatches, projector: Device, free: tuple[int, ...], prior: Prior, settings: JointFitSettings
    ) -> None:
        """`projector` gives the image, the model, and the values that are not free."""
        self._matches, self._projector, self._free, self._prior, self._s = matches, projector, free, prior, settings
        _, self._block = np.unique(matches.block, return_inverse=True)

    def fit(self, poses: Poses) -> JointFit:
        """Levenberg-Marquardt; the kernel follows the noise as it falls, and never widens again."""
        s = self._s
        state, damping, width = _State(values_of(self._projector), poses), s.damping, np.inf
        for _ in range(s.iterations):
            rays = self._rays(state.values)
            width = min(width, s.kernel_sigmas * self._noise(state, rays))
            cost = self._cost(state, width, rays)
            for _ in range(s.tries):
                step, new = self._step(state, rays, width, damping)
                new_cost = self._cost(new, width)
                if new_cost <= cost:
                    state, damping = new, max(damping / s.damping_factor, 1e-12)
                    break
                damping *= s.damping_factor
            else:
                break
            if step < s.converged or cost - new_cost < s.least_gain * cost:
                break
        return self._result(state, width)

    def gauss_newton_step(self, poses: Poses) -> Float64[ndarray, "free"]:
        """One whole step of the free intrinsics from where the problem begins; the poses follow."""
        state = _State(values_of(self._projector), poses)
        rays = self._rays(state.values)
        reduced = self._reduced(state, rays, self._s.kernel_sigmas * self._noise(state, rays), 0.0)
        return -np.linalg.solve(reduced.H, reduced.g)

    def _rays(self, values: Float64[ndarray, "5"]) -> RayPairs:
        return self._matches.rays(device_with(self._projector, values))

    def _noise(self, state: _State, rays: RayPairs) -> float:
        r = self._matches.residuals(state.poses, rays)
        return max(MAD_TO_SIGMA * float(np.nanmedian(np.abs(r))), self._s.noise_floor_px)

    def _cost(self, state: _State, width: float, rays: RayPairs | None = None) -> float:
        """In units of the squared noise, with the prior."""
        rays = self._rays(state.values) if rays is None else rays
        r = np.nan_to_num(self._matches.residuals(state.poses, rays), nan=np.inf)
        data = self._s.kernel_sigmas**2 * float(geman_mcclure_cost((r / width).clip(-1e6, 1e6) ** 2).sum())
        return data + float(self._departure(state.values) @ self._departure(state.values))

    def _departure(self, values: Float64[ndarray, "5"]) -> Float64[ndarray, "free"]:
        free = list(self._free)
        return (values - self._prior.mean)[free] / self._prior.sigma[free]

    def _step(self, state: _State, rays: RayPairs, width: float, damping: float) -> tuple[float, _State]:
        reduced = self._reduced(state, rays, width, damping)
        step = -np.linalg.solve(reduced.H, reduced.g) if self._free else np.zeros(0)
        largest = float(np.abs(step).max(initial=0.0))
        step = step * min(1.0, self._s.largest_step / max(largest, 1e-300))
        values = state.values.copy()
        values[list(self._free)] += step
        by_pose = reduced.pose_step - reduced.pose_slope @ step
        poses = Poses.of([moved(R, t, b) for R, t, b in zip(state.poses.R, state.poses.t, by_pose, strict=True)])
        return max(largest, float(np.abs(by_pose).max())), _State(values, poses)

    def _by_intrinsics(self, state: _State) -> Float64[ndarray, "n free"]:
        """Derivatives of the residuals, by central differences."""
        h, columns = self._s.difference_step, []
        for k in self._free:
            ahead, behind = (
                self._matches.residuals(state.poses, self._rays(state.values + sign * h * np.eye(5)[k]))
                for sign in (1, -1)
            )
            columns.append((ahead - behind) / (2 * h))
        return np.stack(columns, 1) if columns else np.zeros((len(self._matches.frame), 0))

    def _reduced(self, state: _State, rays: RayPairs, width: float, damping: float) -> _Reduced:
        J_free = self._by_intrinsics(state)
        p, frames, noise2 = len(self._free), self._matches.frames, (width / self._s.kernel_sigmas) ** 2
        unexplained, residual = np.zeros_like(J_free), np.zeros(len(J_free))
        pose_step, slope = np.zeros((frames, 5)), np.zeros((frames, 5, p))
        weight = np.zeros(len(J_free))
        for k in range(frames):
            part = self._matches.of_frame(k)
            r, J = sampson_jacobian(state.poses.R[k], state.poses.t[k], rays.chosen(part))
            good = np.isfinite(r) & np.isfinite(J).all(-1) & np.isfinite(J_free[part]).all(-1)
            r, J, J_p = (np.where(good.reshape(-1, *[1] * (a.ndim - 1)), a, 0.0) for a in (r, J, J_free[part]))
            w = np.where(good, geman_mcclure_weight((r / width) ** 2), 0.0)
            A = (J * w[:, None]).T @ J
            A = A + damping * np.diag(np.diag(A)) + 1e-12 * np.trace(A) * np.eye(5)
            slope[k] = np.linalg.solve(A, J.T @ (w[:, None] * J_p))
            pose_step[k] = -np.linalg.solve(A, J.T @ (w * r))
            unexplained[part] = J_p - J @ slope[k]
            residual[part], weight[part] = r, w
        wr = weight * residual
        H = (np.nan_to_num(J_free) * weight[:, None]).T @ unexplained
        g = unexplained.T @ wr
        prior = noise2 / self._prior.sigma[list(self._free)] ** 2
        scores = np.zeros((int(self._block.max(initial=0)) + 1, p))
        np.add.at(scores, self._block, unexplained * wr[:, None])
        H = (H + H.T) / 2 + np.diag(prior)
        g = g + prior * (state.values - self._prior.mean)[list(self._free)]
        return _Reduced(H + damping * np.diag(np.diag(H)), g, pose_step, slope, scores)

    def _result(self, state: _State, width: float) -> JointFit:
        rays = self._rays(state.values)
        noise = width / self._s.kernel_sigmas
        reduced = self._reduced(state, rays, width, 0.0)
        return JointFit(
            device_with(self._projector, state.values),
            state.poses,
            self._free,
            noise,
            self._cost(state, width, rays) / max(len(self._matches.frame), 1),
            self._covariance(reduced, noise),
        )

    def _covariance(self, reduced: _Reduced, noise: float) -> Float64[ndarray, "free free"]:
        """Cluster-robust: errors within a square of the pattern may depend on each other, and within a frame too.

        The larger of both estimates counts, and never less than independent residuals would give.
        """
        if not self._free:
            return np.zeros((0, 0))
        inverse = np.linalg.inv(reduced.H)
        prior = noise**4 * np.diag(1 / self._prior.sigma[list(self._free)] ** 2)
        found = noise**2 * inverse
        for scores in (reduced.scores, self._by_frame(reduced.scores)):
            n, p = len(scores), scores.shape[1]
            if n > 2 * p:
                meat = scores.T @ scores * (n / (n - p)) + prior
                found = _larger(found, inverse @ meat @ inverse)
        return found

    def _by_frame(self, scores: Float64[ndarray, "blocks free"]) -> Float64[ndarray, "frames free"]:
        frame_of_block: Int64[ndarray, blocks] = np.zeros(len(scores), dtype=np.int64)
        frame_of_block[self._block] = self._matches.frame
        out = np.zeros((self._matches.frames, scores.shape[1]))
        np.add.at(out, frame_of_block, scores)
        return out


def _larger(a: Float64[ndarray, "p p"], b: Float64[ndarray, "p p"]) -> Float64[ndarray, "p p"]:
    """`a` with variances at least those of `b`; correlations stay."""
    growth = np.sqrt(np.maximum(np.diag(b) / np.diag(a).clip(1e-300), 1.0))
    return growth[:, None] * a * growth


# What an uncertain camera adds to the uncertainty of the projector that is found with it.


def covariance_by_camera(
    frames: Sequence[FrameMatches],
    camera_sigma: tuple[float, float, float],
    found: JointFit,
    matches_of: Callable[[Sequence[FrameMatches]], PointMatches],
    prior: Prior,
    settings: JointFitSettings,
) -> Float64[ndarray, "free free"]:
    """Of the free intrinsics: by how far they follow each value of the cameras that is moved by 1 sigma.

    `camera_sigma` is of focal length and principal point x, y, in shares of the focal length. A Gauss-Newton step shows
    how far; what is left of it with the cameras as they are does not count.
    """

    def step(change: DeviceChange) -> Float64[ndarray, "free"]:
        moved = [replace(frame, camera=change.applied(frame.camera)) for frame in frames]
        problem = JointProblem(matches_of(moved), found.projector, found.free, prior, settings)
        return problem.gauss_newton_step(found.poses)

    usual = step(DeviceChange(0.0, 0.0, 0.0))
    total = np.zeros((len(found.free), len(found.free)))
    for k, sigma in enumerate(camera_sigma):
        if sigma > 0:
            change = [0.0, 0.0, 0.0]
            change[k] = sigma
            effect = step(DeviceChange(*change)) - usual
            total += np.outer(effect, effect)
    return total


# Which intrinsics are free: another one is, if left-out correspondences agree better with it.

_FURTHER = (LOG_ASPECT, K1)


def choose_model(matches: PointMatches, first: JointFit, prior: Prior, settings: UnknownProjectorSettings) -> JointFit:
    """`first`, or a fit with aspect, distortion or both free.

    Squares of the pattern are left out in turns (k-fold cross-validation), because errors within one depend on each
    other. The smallest model remains unless a larger one agrees better by some standard errors; of several, the one
    that agrees best.
    """
    some = matches.chosen(np.arange(len(matches.frame)) % (1 + len(matches.frame) // settings.choice_most) == 0)
    free = _significant(some, first, prior, settings)
    if not free:
        return first
    candidates = {
        tuple(sorted((*first.free, *extra))) for n in range(1, len(free) + 1) for extra in combinations(free, n)
    }
    base = _left_out(some, first, first.free, prior, settings)
    gains = [(*_gain(base, _left_out(some, first, one, prior, settings), some), one) for one in sorted(candidates)]
    good = [(total, one) for total, error, one in gains if total > settings.standard_errors * error]
    if not good:
        return first
    return JointProblem(matches, first.projector, max(good)[1], prior, settings.fit).fit(first.poses)


def _significant(
    matches: PointMatches, first: JointFit, prior: Prior, settings: UnknownProjectorSettings
) -> tuple[int, ...]:
    """Further intrinsics that depart from their usual values by some standard deviations, if all are free.

    The others cannot improve left-out correspondences by more than chance.
    """
    fit = replace(settings.fit, iterations=settings.fold_iterations)
    found = JointProblem(matches, first.projector, (*first.free, *_FURTHER), prior, fit).fit(first.poses)
    away = np.abs(values_of(found.projector) - values_of(first.projector))[list(_FURTHER)]
    sigma = np.sqrt(np.diag(found.covariance))[len(first.free) :]
    return tuple(k for k, far in zip(_FURTHER, away > settings.standard_errors * sigma, strict=True) if far)


def _left_out(
    matches: PointMatches, first: JointFit, free: tuple[int, ...], prior: Prior, settings: UnknownProjectorSettings
) -> Float64[ndarray, "n"]:
    """Robust cost of every correspondence under the fit to the others."""
    width = settings.fit.kernel_sigmas * first.noise_px
    fold = np.unique(matches.block, return_inverse=True)[1] * 7919 % settings.folds
    out = np.zeros(len(matches.frame))
    fit = replace(settings.fit, iterations=settings.fold_iterations)
    for k in range(settings.folds):
        kept, left = matches.chosen(fold != k), matches.chosen(fold == k)
        found = JointProblem(kept, first.projector, free, prior, fit).fit(first.poses)
        r = left.residuals(found.poses, left.rays(found.projector))
        out[fold == k] = geman_mcclure_cost((np.nan_to_num(r, nan=1e6) / width).clip(-1e6, 1e6) ** 2)
    return out


def _gain(base: Float64[ndarray, "n"], other: Float64[ndarray, "n"], matches: PointMatches) -> tuple[float, float]:
    """By how much the other model costs less, and the standard error; squares are independent."""
    _, block = np.unique(matches.block, return_inverse=True)
    sums = np.bincount(block, base - other)
    return float(sums.sum()), float(np.sqrt((sums**2).sum()))


# First solutions for intrinsics and poses: from fundamental matrices, and from the stated projector.

FOCAL_AND_CENTRE = (LOG_FOCAL, CX, CY)


def frame_rays(matches: PointMatches, projector: Device, k: int) -> RayPairs:
    """The rays of one frame."""
    part = matches.of_frame(k)
    return matches.rays(projector).chosen(np.arange(part.start, part.stop))


def best_start(
    matches: PointMatches,
    projector: Device,
    stated: bool,
    prior: Prior,
    rng: np.random.Generator,
    settings: UnknownProjectorSettings,
) -> tuple[JointFit, list[int]] | None:
    """Focal length and principal point that fit a small part of the correspondences best, and the frames they are from.

    Frames without a fundamental matrix are left out. None if too few have one, or none of the starts converges.
    """
    F = [fundamental_matrix(matches, k, projector, settings.fundamental) for k in range(matches.frames)]
    index = [k for k, one in enumerate(F) if one is not None]
    known = [one for one in F if one is not None]
    if len(known) < 2:
        return None
    some = _thinned_matches(matches, index, settings.start_most, rng)
    places = grid_starts(known, projector, settings.grid)
    log_w = np.log(projector.w)
    devices = [device_with(projector, [np.log(f) + log_w, 0.0, x, y, projector.k1]) for f, x, y in places]
    if stated:
        devices.insert(0, projector)
    fits = [_fit_from(device, known, some, prior, settings) for device in devices]
    return min(fits, key=_ranking(fits, some, settings)), index


def _fit_from(
    device: Device,
    F: Sequence[Float64[ndarray, "3 3"]],
    matches: PointMatches,
    prior: Prior,
    settings: UnknownProjectorSettings,
) -> JointFit:
    poses = [pose_of_fundamental(one, device, frame_rays(matches, device, k)) for k, one in enumerate(F)]
    fit = replace(settings.fit, iterations=settings.start_iterations)
    return JointProblem(matches, device, FOCAL_AND_CENTRE, prior, fit).fit(Poses.of(poses))


def _ranking(fits: Sequence[JointFit], matches: PointMatches, settings: UnknownProjectorSettings):
    """Mean robust cost at the width of the best noise: a fit that gives up half of the pixels must not win."""
    width = settings.fit.kernel_sigmas * min(fit.noise_px for fit in fits)

    def cost(fit: JointFit) -> float:
        r = matches.residuals(fit.poses, matches.rays(fit.projector))
        return float(geman_mcclure_cost((np.nan_to_num(r, nan=1e6) / width).clip(-1e6, 1e6) ** 2).mean())

    return cost


def _thinned_matches(matches: PointMatches, index: Sequence[int], most: int, rng: np.random.Generator) -> PointMatches:
    """Some correspondences of some frames, which are numbered anew."""
    keep, number = [], []
    for new, k in enumerate(index):
        part = np.arange(*matches.of_frame(k).indices(len(matches.frame))[:2])
        part = part if len(part) <= most else np.sort(rng.choice(part, most, replace=False))
        keep.append(part)
        number.append(np.full(len(part), new))
    rows = np.concatenate(keep)
    return PointMatches(
        matches.d_camera[rows], matches.uv_projector[rows], np.concatenate(number), matches.block[rows], len(index)
    )


@dataclass(frozen=True)
class FramePose:
    """The relative pose of a frame with one projector."""

    frame: int
    pose: UnitPose
    flat: bool  # what it sees is a plane within the noise, or the devices are in one place: it says nothing


def poses_with(
    frames: Sequence[FrameMatches], projector: Device, seed: int, settings: UnknownProjectorSettings
) -> list[FramePose]:
    """The relative poses of all frames that have one with a projector."""
    found = []
    for k, frame in enumerate(frames):
        try:
            one = estimate_relative_pose(
                frame.uv_camera, frame.uv_projector, frame.camera, projector, seed, settings.pose
            )
        except RelativePoseError:
            continue
        T = one.T_camera_projector
        flat = any(d.kind in ("planar", "pure rotation") for d in one.degeneracies)
        found.append(FramePose(k, (T[:3, :3], T[:3, 3]), flat))
    return found


Cause = Literal["few frames", "similar frames", "flat", "unknown"]


@dataclass(frozen=True)
class ProjectorEstimate:
    """Intrinsics with their uncertainty. Those that are not free are as stated, or those of square pixels."""

    projector: Device
    covariance: Float64[ndarray, "5 5"]  # of `parameters.NAMES`; zero where not free
    free: tuple[int, ...]
    noise_px: float  # robust standard deviation of the epipolar errors, projector pixels
    frames: tuple[str, ...]  # that were used
    cause: Cause | None  # why it is uncertain; None: it is well determined
    centre_kept: bool  # the principal point is the stated one: the frames do not determine it

    @property
    def sigma(self) -> Float64[ndarray, "5"]:
        """1 sigma of `parameters.NAMES`."""
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
    settings: UnknownProjectorSettings = UNKNOWN_PROJECTOR_DEFAULTS,
    camera_sigma: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> ProjectorEstimate | NoProjector:
    """Intrinsics of the projector for which the epipolar errors of all frames together are smallest.

    `projector` gives size and model, and if `stated` a start for the rest. A model without fundamental matrices (DOE)
    needs a stated one. Lens terms other than k1 stay as they are. `camera_sigma`: 1 sigma of the cameras' focal length
    and principal point, as shares of the focal length.
    """
    if len(frames) < settings.fewest_frames and not stated:
        return NoProjector("few frames", len(frames), np.inf, np.inf)
    rng = np.random.default_rng(seed)
    prior = Prior(values_of(projector), prior_sigma(settings.prior))
    device = _start(frames, projector, stated, prior, rng, settings)
    if device is None:
        return NoProjector("unknown", 0, np.inf, np.inf)
    refined = _refined(frames, device, prior, rng, seed, settings)
    if isinstance(refined, NoProjector):
        return refined
    first, matches, index = refined
    undetermined = _uncertainty(first) > settings.largest_sigma
    if undetermined and stated:
        found = JointProblem(matches, projector, (LOG_FOCAL,), prior, settings.fit).fit(first.poses)
    else:
        found = choose_model(matches, first, prior, settings)
    doubtful = _uncertainty(found) > settings.doubtful_sigma or len(index) < settings.fewest_frames
    cause = _cause(found, len(index), len(frames), settings) if doubtful else None
    if _uncertainty(found) > settings.largest_sigma or found.noise_px > settings.largest_noise_share * projector.w:
        return NoProjector(cause or "unknown", len(index), _uncertainty(found), found.noise_px)
    covariance = np.zeros((5, 5))
    used = [frames[k] for k in index]
    by_camera = covariance_by_camera(
        used, camera_sigma, found, lambda f: _matches(f, projector, seed, settings), prior, settings.fit
    ) if any(camera_sigma) else 0.0  # fmt: skip
    covariance[np.ix_(found.free, found.free)] = found.covariance + by_camera
    return ProjectorEstimate(
        found.projector,
        covariance,
        found.free,
        found.noise_px,
        tuple(frames[k].name for k in index),
        cause,
        undetermined and stated,
    )


def _start(
    frames: Sequence[FrameMatches],
    projector: Device,
    stated: bool,
    prior: Prior,
    rng: np.random.Generator,
    settings: UnknownProjectorSettings,
) -> Device | None:
    """A projector with which the frames' poses can be found."""
    if projector.model == "DOE":
        return projector if stated else None
    matches = PointMatches.of(frames, projector, settings.blocks, settings.fundamental.most, rng)
    found = best_start(matches, projector, stated, prior, rng, settings)
    if found is None:
        return projector if stated else None
    return found[0].projector


def _refined(
    frames: Sequence[FrameMatches],
    device: Device,
    prior: Prior,
    rng: np.random.Generator,
    seed: int,
    settings: UnknownProjectorSettings,
) -> tuple[JointFit, PointMatches, list[int]] | NoProjector:
    """Fit to all frames with depth, with their correspondences and numbers.

    Poses are searched for anew with every projector found: with a wrong one, flat frames end in the wrong one of their
    two solutions. Frames that show a plane fit any projector; their noise would pass for depth.
    """
    some = [_thinned_frame(frame, settings, rng) for frame in frames]
    found: tuple[JointFit, PointMatches, list[int]] | NoProjector = NoProjector("unknown", 0, np.inf, np.inf)
    for _ in range(settings.rounds):
        poses = poses_with(some, device, seed, settings)
        firm = [one for one in poses if not one.flat]
        if len(firm) < settings.fewest_posed:
            return NoProjector("flat" if len(poses) >= settings.fewest_posed else "unknown", len(firm), np.inf, np.inf)
        index = [one.frame for one in firm]
        matches = _matches([frames[k] for k in index], device, seed, settings)
        start = Poses.of([one.pose for one in firm])
        fit = JointProblem(matches, device, FOCAL_AND_CENTRE, prior, settings.fit).fit(start)
        change = np.abs(values_of(fit.projector) - values_of(device))[list(FOCAL_AND_CENTRE)]
        found, device = (fit, matches, index), fit.projector
        if (change < settings.settled * np.sqrt(np.diag(fit.covariance))).all():
            break
    return found


def _matches(
    frames: Sequence[FrameMatches], device: Device, seed: int, settings: UnknownProjectorSettings
) -> PointMatches:
    """As many correspondences as the joint fit takes."""
    most = min(settings.fit.most_per_frame, max(settings.fit.most // len(frames), 1))
    return PointMatches.of(frames, device, settings.blocks, most, np.random.default_rng(seed))


def _thinned_frame(frame: FrameMatches, settings: UnknownProjectorSettings, rng: np.random.Generator) -> FrameMatches:
    """The frame with as many correspondences as a first pose needs."""
    keep = subsample(np.arange(len(frame.uv_camera)), settings.pose.most, rng)
    return replace(frame, uv_camera=frame.uv_camera[keep], uv_projector=frame.uv_projector[keep])


def _uncertainty(found: JointFit) -> float:
    """The largest sigma of focal length and principal point, as a share of the focal length."""
    widths = found.projector.w / found.projector.fl_x
    unit = {LOG_FOCAL: 1.0, CX: widths, CY: widths}
    sigma = np.sqrt(np.diag(found.covariance))
    return max(unit[k] * float(s) for k, s in zip(found.free, sigma, strict=True) if k in unit)


def _cause(found: JointFit, used: int, frames: int, settings: UnknownProjectorSettings) -> Cause:
    """What was measured that explains why the focal length is uncertain."""
    R = Rotation.from_matrix(found.poses.R)
    turns = np.degrees((R * R[0].inv()).magnitude())
    swings = np.degrees(np.arccos((found.poses.t @ found.poses.t[0]).clip(-1, 1)))
    if used > 1 and max(float(turns.max()), float(swings.max())) < settings.alike_deg:
        return "similar frames"
    if 2 * used < frames:
        return "flat"
    return "few frames" if used < settings.few_frames else "unknown"
