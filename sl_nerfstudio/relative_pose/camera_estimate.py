"""The camera's intrinsics from the coordinates of all frames, where its focal length is only roughly known.

All frames share four unknowns: focal length, principal point, first term of the distortion. Each frame has five more,
its relative pose, which are eliminated. What is known beforehand (what the camera itself stated, a principal point near
the middle, a lens with little distortion) counts as a measurement with its own uncertainty.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.robust import geman_mcclure_weight
from sl_nerfstudio.relative_pose.epipolar_fit import noise_of
from sl_nerfstudio.relative_pose.ray_pairs import RayPairs, ray_pairs, subsample
from sl_nerfstudio.relative_pose.sampson import moved, sampson, sampson_jacobian
from sl_nerfstudio.relative_pose.settings import CAMERA_ESTIMATE_DEFAULTS, CameraEstimateSettings

UNKNOWNS = ("log_focal", "centre_x", "centre_y", "k1")  # centres as shares of the image's longer side

UnitPose = tuple[Float64[ndarray, "3 3"], Float64[ndarray, "3"]]  # R and unit t, projector to camera


@dataclass(frozen=True)
class FrameOfCamera:
    """Correspondences of one frame that agree with its relative pose, as found with the rough focal length."""

    uv_camera: Float64[ndarray, "n 2"]
    uv_projector: Float64[ndarray, "n 2"]
    pose: UnitPose


@dataclass(frozen=True)
class CameraEstimate:
    """The camera, and the covariance of its unknowns; it allows for errors shared within squares of the pattern."""

    camera: Device
    covariance: Float64[ndarray, "4 4"]  # of UNKNOWNS

    @property
    def sigma_focal_px(self) -> float:
        """1 sigma of the focal length."""
        return self.camera.fl_x * float(np.sqrt(self.covariance[0, 0]))

    @property
    def sigma_centre_px(self) -> tuple[float, float]:
        """1 sigma of the principal point."""
        x, y = (max(self.camera.w, self.camera.h) * float(np.sqrt(self.covariance[k, k])) for k in (1, 2))
        return x, y

    @property
    def sigma_k1(self) -> float:
        """1 sigma of the first term of the distortion."""
        return float(np.sqrt(self.covariance[3, 3]))


def estimate_camera(
    frames: Sequence[FrameOfCamera],
    camera: Device,
    projector: Device,
    sigma: float,
    seed: int = 0,
    current: Device | None = None,
    settings: CameraEstimateSettings = CAMERA_ESTIMATE_DEFAULTS,
) -> CameraEstimate:
    """The camera with the smallest epipolar errors of all frames together, near the stated one.

    `sigma` is the relative uncertainty of the stated focal length; `current` is the camera with which the poses of the
    frames were found, by default the stated one. Raises ValueError without frames.
    """
    if not frames:
        raise ValueError("no frames")
    rng = np.random.default_rng(seed)
    chosen = [subsample(np.arange(len(frame.uv_camera)), settings.most, rng) for frame in frames]
    prior = np.diag(1 / np.square([sigma, settings.sigma_centre, settings.sigma_centre, settings.sigma_k1]))
    poses, value = [frame.pose for frame in frames], _change(camera, current or camera)
    information = prior

    def rays_at(where: Float64[ndarray, "4"]) -> list[RayPairs]:
        device = changed(camera, where)
        return [
            ray_pairs(frame.uv_camera[index], frame.uv_projector[index], device, projector)[0]
            for frame, index in zip(frames, chosen, strict=True)
        ]

    for _ in range(settings.iterations):
        rays = rays_at(value)
        around = [(rays_at(value + h), rays_at(value - h)) for h in settings.difference_step * np.eye(len(UNKNOWNS))]
        residuals = np.concatenate([sampson(*pose, own) for pose, own in zip(poses, rays, strict=True)])
        width = settings.kernel_sigmas * noise_of(residuals)
        normals = [
            _normal(poses[k], rays[k], [(ahead[k], behind[k]) for ahead, behind in around], width, settings)
            for k in range(len(frames))
        ]
        H, g = sum(n.H for n in normals), sum(n.g for n in normals)
        spread = sum(n.block_gradients.T @ n.block_gradients for n in normals)
        scale = max(float(np.mean(np.diag(spread) / np.diag(H).clip(1e-300))), 1e-12)  # squared error of a measurement
        information = H / scale + prior
        step = np.linalg.solve(information, -g / scale - prior @ value)
        step *= min(1.0, settings.largest_step / max(float(np.abs(step).max()), 1e-300))
        value = value + step
        poses = [moved(*pose, n.pose_step - n.pose_slope @ step) for pose, n in zip(poses, normals, strict=True)]
        if np.abs(step).max() < settings.converged:
            break
    return CameraEstimate(changed(camera, value), np.linalg.inv(information))


def changed(camera: Device, value: Float64[ndarray, "4"]) -> Device:
    """The camera after a change of the logarithm of its focal length, its centre (shares of the longer side) and k1."""
    factor, side = float(np.exp(value[0])), max(camera.w, camera.h)
    return replace(
        camera,
        fl_x=camera.fl_x * factor,
        fl_y=camera.fl_y * factor,
        cx=camera.cx + side * float(value[1]),
        cy=camera.cy + side * float(value[2]),
        k1=camera.k1 + float(value[3]),
    )


def _change(camera: Device, other: Device) -> Float64[ndarray, "4"]:
    """The change that makes a camera the other one."""
    side = max(camera.w, camera.h)
    x, y = (other.cx - camera.cx) / side, (other.cy - camera.cy) / side
    return np.array([np.log(other.fl_x / camera.fl_x), x, y, other.k1 - camera.k1])


@dataclass(frozen=True)
class _Normal:
    """Normal equations of one frame with the pose eliminated: what it adds for the camera."""

    H: Float64[ndarray, "4 4"]
    g: Float64[ndarray, "4"]
    block_gradients: Float64[ndarray, "blocks 4"]
    pose_step: Float64[ndarray, "5"]  # of the pose while the camera stays
    pose_slope: Float64[ndarray, "5 4"]  # change of the pose with the camera


def _normal(
    pose: UnitPose,
    rays: RayPairs,
    around: Sequence[tuple[RayPairs, RayPairs]],
    width: float,
    settings: CameraEstimateSettings,
) -> _Normal:
    """`around`: the same correspondences with each unknown of the camera larger and smaller."""
    apart = 2 * settings.difference_step
    r, J = sampson_jacobian(*pose, rays)
    j = np.stack([(sampson(*pose, ahead) - sampson(*pose, behind)) / apart for ahead, behind in around], 1)
    w = geman_mcclure_weight((r / width) ** 2)[:, None]
    A = (J * w).T @ J
    slope = np.linalg.lstsq(A, (J * w).T @ j, rcond=1e-13)[0]
    unexplained = j - J @ slope  # what the frame's own pose cannot explain
    weighted = w * r[:, None] * unexplained
    pose_step = -np.linalg.lstsq(A, (J * w).T @ r, rcond=1e-13)[0]
    return _Normal((unexplained * w).T @ unexplained, weighted.sum(0), rays.block_sums(weighted), pose_step, slope)
