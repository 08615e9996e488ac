"""Auto-calibration: the pose of the projector against the camera, from one frame's coordinates alone.

Five degrees of freedom; the length of the baseline cannot be seen by one frame and is set to one.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64
from numpy import ndarray

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.relative_pose.degeneracy import Degeneracy, find_degeneracies
from sl_nerfstudio.relative_pose.epipolar_fit import (
    EpipolarFit,
    covariance,
    direction_basis,
    fit_epipolar,
    noise_of,
    sampson,
)
from sl_nerfstudio.relative_pose.five_point import five_point_candidates, in_front
from sl_nerfstudio.relative_pose.ray_pairs import RayPairs, ray_pairs

_FEWEST = 20  # correspondences: five unknowns, and something left to judge the result by
_USED = 20000  # correspondences in the fit; more of the same pixels' neighbours say nothing new
_INLIER = 4.0  # standard deviations of the noise
_LEAST_INLIERS = 0.3
_HOPELESS_PX = 0.02  # of the pattern's width: a fit this bad is no fit


class RelativePoseError(UserError):
    """A frame whose relative pose cannot be found, with the likely cause and the remedy."""


@dataclass(frozen=True)
class RelativePose:
    """Pose of the projector in camera axes, baseline one, with its uncertainty.

    `covariance` is that of (w, b): a turn of the projector about its own centre, in camera axes and radian
    (`R <- exp(w) R`), and a swing of the baseline (`t <- exp(B b) t`, B = `epipolar_fit.direction_basis(t)`).
    It allows for errors that neighbouring pixels share, within squares of 1/25 of the pattern; errors common to
    the whole frame (intrinsics) are not in it.
    """

    T_camera_projector: Float64[ndarray, "4 4"]
    covariance: Float64[ndarray, "5 5"]
    inliers: Bool[ndarray, "n"]  # of the correspondences given: epipolar error within four sigma, in front of both
    residual_px: float  # robust standard deviation of the epipolar error, projector pixels
    degeneracies: tuple[Degeneracy, ...]

    @property
    def sigma_rotation_deg(self) -> float:
        """One standard deviation of the rotation's angle (root of the sum over its three axes)."""
        return float(np.degrees(np.sqrt(np.trace(self.covariance[:3, :3]))))

    @property
    def sigma_direction_deg(self) -> float:
        """One standard deviation of the angle by which the baseline's direction is wrong."""
        return float(np.degrees(np.sqrt(np.trace(self.covariance[3:, 3:]))))

    @property
    def covariance_of_twist(self) -> Float64[ndarray, "6 6"]:
        """Covariance of (v, w): error of the projector's position (unit baseline) and turn, in camera axes."""
        t = self.T_camera_projector[:3, 3]
        B = direction_basis(t)
        J = np.zeros((6, 5))
        J[:3, 3:] = np.cross(B.T, t).T  # exp(B b) t = t + (B b) x t
        J[3:, :3] = np.eye(3)
        return J @ self.covariance @ J.T


def estimate_relative_pose(
    uv_camera: Float[ndarray, "n 2"],
    uv_projector: Float[ndarray, "n 2"],
    camera: Device,
    projector: Device,
    seed: int = 0,
) -> RelativePose:
    """Relative pose of camera and projector from decoded pixels; any projector model, any lens.

    Raises CalibrationError, with cause and remedy, where there are too few correspondences, or where no pose fits
    most of them.
    """
    rng = np.random.default_rng(seed)
    rays, usable = ray_pairs(uv_camera, uv_projector, camera, projector)
    if len(rays) < _FEWEST:
        raise RelativePoseError(
            f"{len(rays)} decoded pixels are too few to find the projector's pose (at least {_FEWEST})\n"
            "    cause:  the pattern was not found, or lies beside the object\n"
            "    remedy: more light, less exposure by other sources, the object larger in the image"
        )
    some = rays if len(rays) <= _USED else rays.chosen(rng.choice(len(rays), _USED, replace=False))
    candidates = five_point_candidates(some, rng)
    if not candidates:
        raise _no_pose("no relative pose puts most points in front of both devices")
    found = fit_epipolar(candidates[0].fit.R, candidates[0].fit.t, some)
    rival = next((c.fit for c in candidates[1:] if _apart(c.fit, found)), None)
    good = _inliers(found, rays)
    if found.noise_px > _HOPELESS_PX * projector.w or good.mean() < _LEAST_INLIERS:
        raise _no_pose(
            f"the best relative pose fits {good.mean():.0%} of the decoded pixels to within {found.noise_px:.2g} px"
        )
    cov = covariance(found, some)
    sigma = np.degrees(np.sqrt(np.trace(cov[:3, :3]))), np.degrees(np.sqrt(np.trace(cov[3:, 3:])))
    part = np.abs(found.residual) < _INLIER * found.noise_px
    degeneracies = find_degeneracies(found, some, part, (float(sigma[0]), float(sigma[1])), rival)
    inliers = np.zeros(len(uv_camera), dtype=bool)
    inliers[usable] = good
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = found.R, found.t
    return RelativePose(T, cov, inliers, found.noise_px, degeneracies)


def judge_relative_pose(
    T_camera_projector: Float64[ndarray, "4 4"],
    uv_camera: Float[ndarray, "n 2"],
    uv_projector: Float[ndarray, "n 2"],
    camera: Device,
    projector: Device,
) -> RelativePose:
    """A pose that is known otherwise, judged by a frame's coordinates as `estimate_relative_pose` judges its own."""
    rays, usable = ray_pairs(uv_camera, uv_projector, camera, projector)
    if len(rays) < _FEWEST:
        raise RelativePoseError(f"{len(rays)} decoded pixels are too few to judge a pose (at least {_FEWEST})")
    T = T_camera_projector.copy()
    T[:3, 3] /= np.linalg.norm(T[:3, 3])
    r = sampson(T[:3, :3], T[:3, 3], rays)
    found = EpipolarFit(T[:3, :3], T[:3, 3], r, noise_of(r), 0.0)
    inliers = np.zeros(len(uv_camera), dtype=bool)
    inliers[usable] = _inliers(found, rays)
    return RelativePose(T, covariance(found, rays), inliers, found.noise_px, ())


def _inliers(found: EpipolarFit, rays: RayPairs) -> Bool[ndarray, "n"]:
    close = np.abs(sampson(found.R, found.t, rays)) < _INLIER * found.noise_px
    return close & in_front(found.R, found.t, rays)


def _apart(a: EpipolarFit, b: EpipolarFit) -> bool:
    """Whether two solutions differ by more than an unfinished fit does."""
    return bool(np.linalg.norm(a.R - b.R) > 0.05 or np.linalg.norm(a.t - b.t) > 0.1)


def _no_pose(problem: str) -> RelativePoseError:
    return RelativePoseError(
        f"{problem}\n"
        "    cause:  the pattern file is not the one that was projected, the intrinsics are another device's, the "
        "image is mirrored or turned, or most coordinates are wrong\n"
        "    remedy: check pattern and intrinsics (their image sizes first), and look at the decoded coordinates"
    )
