"""Relative pose estimation: the pose of the projector relative to the camera, from one frame's coordinates alone.

Five degrees of freedom; the length of the baseline cannot be seen in one frame and is set to one.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64
from numpy import ndarray

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.relative_pose.degeneracy import Degeneracy, find_degeneracies
from sl_nerfstudio.relative_pose.epipolar_fit import EpipolarFit, covariance, distinct, fit_epipolar
from sl_nerfstudio.relative_pose.five_point import five_point_candidates, in_front
from sl_nerfstudio.relative_pose.pattern_blocks import block_count
from sl_nerfstudio.relative_pose.ray_pairs import RayPairs, ray_pairs, subsample
from sl_nerfstudio.relative_pose.sampson import sampson
from sl_nerfstudio.relative_pose.settings import RELATIVE_POSE_DEFAULTS, RelativePoseSettings


class RelativePoseError(UserError):
    """A frame whose relative pose cannot be found, with the likely cause and the remedy."""


@dataclass(frozen=True)
class RelativePose:
    """Pose of the projector in camera axes, baseline one, with its uncertainty.

    `covariance` is that of (w, b): a rotation of the projector about its own centre, in camera axes and radian
    (`R <- exp(w) R`), and a rotation of the baseline (`t <- exp(B b) t`, B = `sampson.direction_basis(t)`).
    It allows for errors that neighbouring pixels share, within squares of 1/25 of the pattern; errors of the whole
    frame (intrinsics) are not included.
    """

    T_camera_projector: Float64[ndarray, "4 4"]
    covariance: Float64[ndarray, "5 5"]
    inliers: Bool[ndarray, "n"]  # of the correspondences given: epipolar error within four sigma, in front of both
    residual_px: float  # robust standard deviation of the epipolar error, projector pixels
    degeneracies: tuple[Degeneracy, ...]

    @property
    def sigma_rotation_deg(self) -> float:
        """One standard deviation of the rotation's angle (root of the sum over its three axes)."""
        return _angle_sigma_deg(self.covariance[:3, :3])

    @property
    def sigma_direction_deg(self) -> float:
        """One standard deviation of the angle by which the baseline's direction is wrong."""
        return _angle_sigma_deg(self.covariance[3:, 3:])


def estimate_relative_pose(
    uv_camera: Float[ndarray, "n 2"],
    uv_projector: Float[ndarray, "n 2"],
    camera: Device,
    projector: Device,
    seed: int = 0,
    settings: RelativePoseSettings = RELATIVE_POSE_DEFAULTS,
) -> RelativePose:
    """Relative pose of camera and projector from decoded pixels; any projector model, any lens.

    Raises RelativePoseError, with cause and remedy, where there are too few correspondences, or where no pose fits
    most of them.
    """
    rng = np.random.default_rng(seed)
    rays, usable = ray_pairs(uv_camera, uv_projector, camera, projector, settings.blocks)
    if len(rays) < settings.fewest:
        raise RelativePoseError(
            f"{len(rays)} decoded pixels are too few to find the projector's pose (at least {settings.fewest})\n"
            "    cause:  the pattern was not found, or lies beside the object\n"
            "    remedy: more light, less exposure by other sources, the object larger in the image"
        )
    some = rays.chosen(subsample(np.arange(len(rays)), settings.most, rng))
    candidates = five_point_candidates(some, rng, settings)
    if not candidates:
        raise _no_pose("no relative pose puts most points in front of both devices")
    found = fit_epipolar(candidates[0].fit.R, candidates[0].fit.t, some, settings.fit)
    others = (c.fit for c in candidates[1:])
    second_best = next((o for o in others if distinct((o.R, o.t), (found.R, found.t), settings.second_best)), None)
    good = _inliers(found, rays, settings.inlier_sigmas)
    if found.noise_px > settings.largest_noise_share * projector.w or good.mean() < settings.least_inlier_share:
        raise _no_pose(
            f"the best relative pose fits {good.mean():.0%} of the decoded pixels to within {found.noise_px:.2g} px"
        )
    cov = covariance(found, some, settings.fit)
    degeneracies = find_degeneracies(
        found,
        some,
        np.abs(found.residual) < settings.inlier_sigmas * found.noise_px,
        (_angle_sigma_deg(cov[:3, :3]), _angle_sigma_deg(cov[3:, 3:])),
        second_best,
        block_count(projector, settings.blocks),
        settings.degeneracy,
    )
    inliers = np.zeros(len(uv_camera), dtype=bool)
    inliers[usable] = good
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = found.R, found.t
    return RelativePose(T, cov, inliers, found.noise_px, degeneracies)


def _inliers(found: EpipolarFit, rays: RayPairs, sigmas: float) -> Bool[ndarray, "n"]:
    close = np.abs(sampson(found.R, found.t, rays)) < sigmas * found.noise_px
    return close & in_front(found.R, found.t, rays)


def _angle_sigma_deg(covariance_rad: Float64[ndarray, "k k"]) -> float:
    return float(np.degrees(np.sqrt(np.trace(covariance_rad))))


def _no_pose(problem: str) -> RelativePoseError:
    return RelativePoseError(
        f"{problem}\n"
        "    cause:  the pattern file is not the one that was projected, the intrinsics are another device's, the "
        "image is mirrored or turned, or most coordinates are wrong\n"
        "    remedy: check pattern and intrinsics (their image sizes first), and look at the decoded coordinates"
    )
