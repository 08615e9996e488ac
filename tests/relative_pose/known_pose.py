"""A relative pose that is known, with the covariance and inliers that a frame's coordinates give it."""

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.relative_pose.epipolar import EpipolarFit, covariance, noise_of, ray_pairs, sampson
from sl_nerfstudio.relative_pose.estimation import INLIER_SIGMAS, RelativePose


def known_pose(
    T_camera_projector: Float64[ndarray, "4 4"],
    uv_camera: Float64[ndarray, "n 2"],
    uv_projector: Float64[ndarray, "n 2"],
    camera: Device,
    projector: Device,
) -> RelativePose:
    rays, usable = ray_pairs(uv_camera, uv_projector, camera, projector)
    T = T_camera_projector.copy()
    T[:3, 3] /= np.linalg.norm(T[:3, 3])
    r = sampson(T[:3, :3], T[:3, 3], rays)
    fit = EpipolarFit(T[:3, :3], T[:3, 3], r, noise_of(r))
    inliers, noise_px = np.zeros(len(uv_camera), dtype=bool), np.full(len(uv_camera), np.nan)
    inliers[usable] = np.abs(r) < INLIER_SIGMAS * fit.noise_px
    noise_px[usable] = fit.noise_px
    return RelativePose(T, covariance(fit, rays), inliers, fit.noise_px, noise_px, 1.0, ())
