"""Intrinsics of one device fitted together with the relative poses of all frames, by their epipolar geometry.

The residuals are Sampson's. Each frame's five unknowns are eliminated, so the equations have the size of the
intrinsics. What is known beforehand counts as a measurement with its own uncertainty.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.least_squares import BlockEquations, minimise
from sl_nerfstudio.geometry.numerics import all_finite, geman_mcclure_cost, geman_mcclure_weight
from sl_nerfstudio.relative_pose.epipolar import (
    KERNEL_SIGMAS,
    RayPairs,
    UnitPose,
    blocks_of,
    directions,
    directions_by_uv,
    moved,
    noise_of,
    sampson_jacobian,
    sampson_of_frames,
)

MOST_MATCHES, MOST_PER_FRAME = 40_000, 3000  # in a fit, of all frames together and of one
DIFFERENCE_STEP = 1e-5  # of the intrinsics, for derivatives
LARGEST_STEP = 0.3  # of the intrinsics; principal points in widths
TOLERANCE = 1e-6  # share of the cost that may be left to gain

# A device's intrinsics as a vector: logarithms of focal length and aspect, principal point in widths, k1.

NAMES = ("log_focal", "log_aspect", "cx", "cy", "k1")
LOG_FOCAL, LOG_ASPECT, CX, CY, K1 = range(len(NAMES))
FOCAL_AND_CENTRE = (LOG_FOCAL, CX, CY)
PRIOR_SIGMA = np.array([0.7, 0.1, 0.5, 1.0, 0.1])
"""1 sigma of any projector around the usual values: keystone correction and scaling change the aspect, and lens shift
moves the principal point far outside the image."""


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

    uv_camera: Float64[ndarray, "n 2"]
    d_camera: Float64[ndarray, "n 3"]
    uv_projector: Float64[ndarray, "n 2"]
    frame: Int64[ndarray, "n"]
    block: Int64[ndarray, "n"]  # frame and square of the pattern; errors within one may depend on each other
    frames: int

    @staticmethod
    def of(frames: Sequence[FrameMatches], projector: Device, most: int, rng: np.random.Generator) -> "PointMatches":
        """Choose at most `most` correspondences of each frame, by chance."""
        parts = []
        for k, frame in enumerate(frames):
            d = directions(frame.camera, frame.uv_camera)
            usable = np.flatnonzero(all_finite(d) & all_finite(frame.uv_projector))
            if len(usable) > most:
                usable = np.sort(rng.choice(usable, most, replace=False))
            uv = frame.uv_projector[usable]
            block = k * 1_000_000 + blocks_of(uv, projector)
            parts.append((frame.uv_camera[usable], d[usable], uv, np.full(len(usable), k), block))
        uv_camera, d_camera, uv, number, block = (np.concatenate(part) for part in zip(*parts, strict=True))
        return PointMatches(uv_camera, d_camera, uv, number, block, len(frames))

    def chosen(self, keep: Bool[ndarray, "n"] | Int64[ndarray, "m"]) -> "PointMatches":
        """Some of the correspondences, of the same frames."""
        rays = self.uv_camera[keep], self.d_camera[keep], self.uv_projector[keep]
        return PointMatches(*rays, self.frame[keep], self.block[keep], self.frames)

    def of_frame(self, k: int) -> slice:
        """Slice of a frame's correspondences."""
        return slice(*np.searchsorted(self.frame, [k, k + 1]).tolist())

    def rays(self, projector: Device) -> RayPairs:
        """The rays with a projector; those that have none are NaN."""
        return RayPairs(self.d_camera, *directions_by_uv(projector, self.uv_projector), self.block)


@dataclass(frozen=True)
class JointState:
    """Intrinsics, and relative poses of all frames with baseline one."""

    values: Float64[ndarray, "5"]
    R: Float64[ndarray, "frames 3 3"]  # projector to camera
    t: Float64[ndarray, "frames 3"]

    @property
    def poses(self) -> list[UnitPose]:
        """The pose of each frame."""
        return list(zip(self.R, self.t, strict=True))


@dataclass(frozen=True)
class JointFit:
    """Intrinsics and poses for which the coordinates lie nearest to their epipolar curves."""

    device: Device
    poses: list[UnitPose]
    free: tuple[int, ...]  # which of the intrinsics
    noise_px: float  # robust standard deviation of the residuals
    covariance: Float64[ndarray, "free free"]


@dataclass(frozen=True)
class Linearised:
    """Normal equations at a state, without the prior, and what they are made of."""

    equations: BlockEquations
    by_free: Float64[ndarray, "n free"]  # derivatives of the residuals by the intrinsics
    by_pose: Float64[ndarray, "n 5"]
    weighted: Float64[ndarray, "n"]  # residuals times their weights


class JointProblem:
    """One choice of free intrinsics, for given correspondences."""

    def __init__(
        self,
        matches: PointMatches,
        device: Device,
        free: tuple[int, ...],
        mean: Float64[ndarray, "5"],
        rays: Callable[[Device], RayPairs] | None = None,
    ) -> None:
        """Set up the problem of a device, by default the projector.

        Args:
            matches: the correspondences.
            device: the image, the model, the start, and the values that are not free.
            free: which intrinsics are fitted.
            mean: values that are expected, to within PRIOR_SIGMA.
            rays: the rays of the correspondences with another device of its kind.
        """
        self._matches, self._device, self._free, self._rays_with = matches, device, list(free), rays or matches.rays
        self._offset, self._sigma = mean[self._free], PRIOR_SIGMA[self._free]
        _, self._block = np.unique(matches.block, return_inverse=True)
        self._width = np.inf
        self._kept: tuple[JointState, ndarray] | None = None  # the last state, and its residuals

    def fit(self, poses: Sequence[UnitPose], iterations: int = 40) -> JointFit:
        """Levenberg-Marquardt; the kernel follows the noise as it falls, and never widens again."""
        self._width = np.inf
        found = minimise(
            self.start(poses), self._equations, self.moved, self._cost, narrow=self._narrow, iterations=iterations,
            tolerance=TOLERANCE,
        ).state  # fmt: skip
        noise = self._width / KERNEL_SIGMAS
        covariance = self._covariance(self.linearised(found, self._width), noise)
        return JointFit(device_with(self._device, found.values), found.poses, tuple(self._free), noise, covariance)

    def gauss_newton_step(self, poses: Sequence[UnitPose]) -> Float64[ndarray, "free"]:
        """One whole step of the free intrinsics from where the problem begins; the poses follow."""
        self._width, state = np.inf, self.start(poses)
        self._narrow(state)
        return self._equations(state).step(0.0)[0]

    def start(self, poses: Sequence[UnitPose]) -> JointState:
        """The device as it is, with given poses."""
        return JointState(values_of(self._device), np.stack([R for R, _ in poses]), np.stack([t for _, t in poses]))

    def residuals(self, state: JointState) -> Float64[ndarray, "n"]:
        """Distances of the coordinates from their epipolar curves; NaN where there is no ray."""
        rays = self._rays_with(device_with(self._device, state.values))
        return sampson_of_frames(state.R, state.t, rays, self._matches.frame)

    def moved(
        self, state: JointState, step: tuple[Float64[ndarray, "free"], Float64[ndarray, "frames 5"]]
    ) -> JointState:
        """The state after a step, which is shortened if it changes the intrinsics by too much."""
        shared, by_pose = step
        share = min(1.0, LARGEST_STEP / max(float(np.abs(shared).max(initial=0.0)), 1e-300))
        values = state.values.copy()
        values[self._free] += share * shared
        poses = [moved(R, t, share * b) for R, t, b in zip(state.R, state.t, by_pose, strict=True)]
        return JointState(values, np.stack([R for R, _ in poses]), np.stack([t for _, t in poses]))

    def _residuals(self, state: JointState) -> Float64[ndarray, "n"]:
        if self._kept is None or self._kept[0] is not state:
            self._kept = state, self.residuals(state)
        return self._kept[1]

    def _narrow(self, state: JointState) -> None:
        r = self._residuals(state)
        self._width = min(self._width, KERNEL_SIGMAS * noise_of(r[np.isfinite(r)]))

    def _cost(self, state: JointState) -> float:
        r = np.nan_to_num(self._residuals(state), nan=np.inf)
        data = self._width**2 * float(geman_mcclure_cost((r / self._width).clip(-1e6, 1e6) ** 2).sum())
        departure = (state.values[self._free] - self._offset) / self._sigma
        return (data + (self._width / KERNEL_SIGMAS) ** 2 * float(departure @ departure)) / 2

    def _equations(self, state: JointState) -> BlockEquations:
        e, prior = self.linearised(state, self._width).equations, (self._width / KERNEL_SIGMAS / self._sigma) ** 2
        return replace(e, H=e.H + np.diag(prior), g=e.g + prior * (state.values[self._free] - self._offset))

    def linearised(self, state: JointState, width: float) -> Linearised:
        """Normal equations with a kernel of a given width."""
        matches, rays = self._matches, self._rays_with(device_with(self._device, state.values))
        J_free = self._by_intrinsics(state)
        parts = [matches.of_frame(k) for k in range(matches.frames)]
        r, J = np.zeros(len(J_free)), np.zeros((len(J_free), 5))
        for part, R, t in zip(parts, state.R, state.t, strict=True):
            r[part], J[part] = sampson_jacobian(R, t, rays.chosen(part))
        good = np.isfinite(r) & all_finite(J) & all_finite(J_free)
        r, J, J_free = np.where(good, r, 0.0), np.where(good[:, None], J, 0.0), np.where(good[:, None], J_free, 0.0)
        w = np.where(good, geman_mcclure_weight((r / width) ** 2), 0.0)
        wJ, wr = w[:, None] * J, w * r
        equations = BlockEquations(
            (J_free * w[:, None]).T @ J_free,
            J_free.T @ wr,
            np.stack([wJ[part].T @ J[part] for part in parts]),
            np.stack([J[part].T @ wr[part] for part in parts]),
            np.stack([J_free[part].T @ wJ[part] for part in parts]),
        )
        return Linearised(equations, J_free, J, wr)

    def scores(self, at: Linearised) -> Float64[ndarray, "blocks free"]:
        """Contribution of each square of the pattern in each frame to the gradient, with the poses eliminated."""
        slopes = at.equations.slopes()[self._matches.frame]
        unexplained = at.by_free - np.einsum("nk,nks->ns", at.by_pose, slopes)
        scores = np.zeros((int(self._block.max(initial=0)) + 1, len(self._free)))
        np.add.at(scores, self._block, unexplained * at.weighted[:, None])
        return scores

    def _by_intrinsics(self, state: JointState) -> Float64[ndarray, "n free"]:
        """Derivatives of the residuals, by central differences."""
        columns = []
        for k in self._free:
            step = DIFFERENCE_STEP * np.eye(5)[k]
            ahead, behind = (self.residuals(replace(state, values=state.values + s * step)) for s in (1, -1))
            columns.append((ahead - behind) / (2 * DIFFERENCE_STEP))
        return np.stack(columns, 1) if columns else np.zeros((len(self._matches.frame), 0))

    def _covariance(self, at: Linearised, noise: float) -> Float64[ndarray, "free free"]:
        """Cluster-robust covariance: errors within a square of the pattern may depend on each other, or within a frame.

        The larger of both estimates counts, and never less than independent residuals would give.
        """
        if not self._free:
            return np.zeros((0, 0))
        prior = noise**2 * np.diag(1 / self._sigma**2)
        inverse = np.linalg.inv(at.equations.reduced().H + prior)
        found, by_block = noise**2 * inverse, self.scores(at)
        for scores in (by_block, self._by_frame(by_block)):
            n, p = scores.shape
            if n > 2 * p:
                meat = scores.T @ scores * (n / (n - p)) + noise**2 * prior
                found = with_larger_variances(found, inverse @ meat @ inverse)
        return found

    def _by_frame(self, scores: Float64[ndarray, "blocks free"]) -> Float64[ndarray, "frames free"]:
        frame_of_block: Int64[ndarray, blocks] = np.zeros(len(scores), dtype=np.int64)
        frame_of_block[self._block] = self._matches.frame
        out = np.zeros((self._matches.frames, scores.shape[1]))
        np.add.at(out, frame_of_block, scores)
        return out


def with_larger_variances(a: Float64[ndarray, "p p"], b: Float64[ndarray, "p p"]) -> Float64[ndarray, "p p"]:
    """`a` with variances at least those of `b`; correlations stay."""
    growth = np.sqrt(np.maximum(np.diag(b) / np.diag(a).clip(1e-300), 1.0))
    return growth[:, None] * a * growth
