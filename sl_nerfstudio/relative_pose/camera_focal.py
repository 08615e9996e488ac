"""The camera's focal length from the coordinates of all frames, where it is only roughly known.

All frames share one unknown (a factor of fl_x and fl_y); each has five more, its relative pose, which are eliminated.
What the camera itself stated counts as one more measurement, with its own uncertainty.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.robust import geman_mcclure_weight
from sl_nerfstudio.relative_pose.epipolar_fit import noise_of
from sl_nerfstudio.relative_pose.ray_pairs import RayPairs, ray_pairs, subsample
from sl_nerfstudio.relative_pose.sampson import moved, sampson, sampson_jacobian

_MOST = 3000  # correspondences of each frame
_ITERATIONS = 12
_LARGEST_STEP = 0.05  # of the logarithm of the focal length
_DIFFERENCE = 1e-5  # of the same, for derivatives
_CONVERGED = 1e-8
_KERNEL = 3.0  # width of the robust kernel, standard deviations of the residuals

UnitPose = tuple[Float64[ndarray, "3 3"], Float64[ndarray, "3"]]  # R and unit t, projector to camera


@dataclass(frozen=True)
class FrameOfCamera:
    """Correspondences of one frame that agree with its relative pose, as found with the rough focal length."""

    uv_camera: Float64[ndarray, "n 2"]
    uv_projector: Float64[ndarray, "n 2"]
    pose: UnitPose


@dataclass(frozen=True)
class CameraFocal:
    """The camera's focal length, over the rough one; sigmas allow for errors shared within squares of the pattern."""

    factor: float  # from the frames and the rough value together
    sigma: float
    from_frames: float  # from the frames alone
    sigma_from_frames: float


def estimate_camera_focal(
    frames: Sequence[FrameOfCamera], camera: Device, projector: Device, sigma: float, seed: int = 0
) -> CameraFocal:
    """Factor of the camera's focal length with the smallest epipolar errors of all frames together.

    `sigma` is the relative uncertainty of the stated one. Raises ValueError without frames.
    """
    if not frames:
        raise ValueError("no frames")
    rng = np.random.default_rng(seed)
    chosen = [subsample(np.arange(len(frame.uv_camera)), _MOST, rng) for frame in frames]
    poses, value, found = [frame.pose for frame in frames], 0.0, np.inf
    for _ in range(_ITERATIONS):
        rays, ahead, behind = (
            [_rays(frame, index, camera, projector, value + h) for frame, index in zip(frames, chosen, strict=True)]
            for h in (0.0, _DIFFERENCE, -_DIFFERENCE)
        )
        residuals = np.concatenate([sampson(*pose, own) for pose, own in zip(poses, rays, strict=True)])
        width = _KERNEL * noise_of(residuals)
        normals = [_normal(*parts, width) for parts in zip(poses, rays, ahead, behind, strict=True)]
        H = max(sum(n.H for n in normals), 1e-300)
        step = float(np.clip(-sum(n.g for n in normals) / H, -_LARGEST_STEP, _LARGEST_STEP))
        value += step
        poses = [moved(*pose, n.pose_step - n.pose_slope * step) for pose, n in zip(poses, normals, strict=True)]
        found = float(np.sqrt(sum((n.block_gradients**2).sum() for n in normals)) / H)
        if abs(step) < _CONVERGED:
            break
    found = max(found, 1e-9)
    weight = sigma**2 / (sigma**2 + found**2)  # of the frames, against the stated focal length
    both = float(np.exp(weight * value))
    return CameraFocal(both, both * found * np.sqrt(weight), float(np.exp(value)), float(np.exp(value)) * found)


@dataclass(frozen=True)
class _Normal:
    """Normal equations of one frame with the pose eliminated: what it adds for the focal length."""

    H: float
    g: float
    block_gradients: Float64[ndarray, "blocks"]
    pose_step: Float64[ndarray, "5"]  # of the pose while the focal length stays
    pose_slope: Float64[ndarray, "5"]  # change of the pose with the focal length


def _normal(pose: UnitPose, rays: RayPairs, ahead: RayPairs, behind: RayPairs, width: float) -> _Normal:
    """`ahead` and `behind`: the same correspondences with a focal length that is larger and smaller."""
    r, J = sampson_jacobian(*pose, rays)
    j = (sampson(*pose, ahead) - sampson(*pose, behind)) / (2 * _DIFFERENCE)
    w = geman_mcclure_weight((r / width) ** 2)
    A = (J * w[:, None]).T @ J
    slope = np.linalg.lstsq(A, J.T @ (w * j), rcond=1e-13)[0]
    unexplained = j - J @ slope  # what the frame's own pose cannot explain
    gradients = rays.block_sums(w * r * unexplained)
    pose_step = -np.linalg.lstsq(A, J.T @ (w * r), rcond=1e-13)[0]
    return _Normal(float(w @ unexplained**2), float((w * unexplained) @ r), gradients, pose_step, slope)


def _rays(
    frame: FrameOfCamera, index: Int64[ndarray, "m"], camera: Device, projector: Device, value: float
) -> RayPairs:
    factor = float(np.exp(value))
    device = replace(camera, fl_x=camera.fl_x * factor, fl_y=camera.fl_y * factor)
    return ray_pairs(frame.uv_camera[index], frame.uv_projector[index], device, projector)[0]
