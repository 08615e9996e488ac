"""Robust fit of the projector's intrinsics together with the relative poses of all frames.

Each frame's five unknowns are eliminated (Schur complement), so that the equations have the size of the intrinsics.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.robust import MAD_TO_SIGMA, geman_mcclure_cost, geman_mcclure_weight
from sl_nerfstudio.relative_pose.ray_pairs import RayPairs
from sl_nerfstudio.relative_pose.sampson import moved, sampson_jacobian
from sl_nerfstudio.relative_pose.unknown_projector.matches import Matches, Poses
from sl_nerfstudio.relative_pose.unknown_projector.parameters import device_with, values_of
from sl_nerfstudio.relative_pose.unknown_projector.settings import JointFitSettings


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
        self, matches: Matches, projector: Device, free: tuple[int, ...], prior: Prior, settings: JointFitSettings
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
