"""The projector's focal length from the coordinates of all frames, where the stated one is only roughly right.

All frames share one unknown (a factor of fl_x and fl_y); each has five more, its relative pose, which are eliminated.
A factor of the focal length and a rotation of the projector look much alike in one frame; many frames separate them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.robust import geman_mcclure_weight
from sl_nerfstudio.relative_pose.epipolar_fit import fit_epipolar, noise_of
from sl_nerfstudio.relative_pose.estimation import RelativePose
from sl_nerfstudio.relative_pose.ray_pairs import RayPairs, ray_pairs, subsample
from sl_nerfstudio.relative_pose.sampson import moved, sampson, sampson_jacobian
from sl_nerfstudio.relative_pose.settings import FOCAL_DEFAULTS, FocalSettings

UnitPose = tuple[Float64[ndarray, "3 3"], Float64[ndarray, "3"]]  # R and unit t, projector to camera


@dataclass(frozen=True)
class PosedFrame:
    """Correspondences of one frame and the relative pose that was found with the stated intrinsics."""

    uv_camera: Float64[ndarray, "n 2"]
    uv_projector: Float64[ndarray, "n 2"]
    camera: Device
    pose: RelativePose


@dataclass(frozen=True)
class FocalLength:
    """A projector with refined focal lengths, and whether the captures support the change."""

    projector: Device
    factor: float  # refined over stated
    sigma: float  # 1 sigma of the factor; errors shared within squares of the pattern are allowed for
    residual_px: tuple[float, float]  # robust epipolar error of all frames, before and after
    significant: bool  # the stated value is wrong by more than three sigma


@dataclass(frozen=True)
class _Normal:
    """Normal equations of one frame with the pose eliminated: what it adds for the focal length."""

    H: float
    g: float
    block_gradients: Float64[ndarray, "blocks"]
    pose_step: Float64[ndarray, "5"]  # of the pose while the focal length stays
    pose_slope: Float64[ndarray, "5"]  # change of the pose with the focal length


def refine_projector_focal(
    frames: Sequence[PosedFrame], projector: Device, seed: int = 0, settings: FocalSettings = FOCAL_DEFAULTS
) -> FocalLength:
    """Focal length of the projector for which the epipolar errors of all frames together are smallest.

    Raises UserError without frames, and where a coordinate has no ray with a changed focal length. The relative poses
    must be estimated again with the result.
    """
    if not frames:
        raise UserError("there is no frame with a relative pose to find the projector's focal length from")
    rng = np.random.default_rng(seed)
    chosen = [subsample(np.flatnonzero(f.pose.inliers), settings.most, rng) for f in frames]
    poses = [(f.pose.T_camera_projector[:3, :3], f.pose.T_camera_projector[:3, 3]) for f in frames]
    log_factor, sigma = 0.0, np.inf

    def rays_at(value: float) -> list[RayPairs]:
        device = _with_factor(projector, value)
        return [_rays(f, index, device, settings) for f, index in zip(frames, chosen, strict=True)]

    rays = rays_at(log_factor)
    before = _noise(poses, rays, settings)
    for _ in range(settings.iterations):
        width = settings.kernel_sigmas * _noise(poses, rays, settings)
        h = settings.difference_step
        around = zip(rays_at(log_factor + h), rays_at(log_factor - h), strict=True)
        normals = [_normal(pose, own, sides, width, h) for pose, own, sides in zip(poses, rays, around, strict=True)]
        H, g = sum(n.H for n in normals), sum(n.g for n in normals)
        step = float(np.clip(-g / max(H, 1e-300), -settings.largest_step, settings.largest_step))
        log_factor += step
        poses = [moved(*pose, n.pose_step - n.pose_slope * step) for pose, n in zip(poses, normals, strict=True)]
        sigma = float(np.sqrt(sum((n.block_gradients**2).sum() for n in normals)) / max(H, 1e-300))
        rays = rays_at(log_factor)
        if abs(step) < settings.converged:
            break
    fit = replace(settings.fit, iterations=settings.final_iterations)
    poses = [(f.R, f.t) for f in (fit_epipolar(*pose, own, fit) for pose, own in zip(poses, rays, strict=True))]
    factor = float(np.exp(log_factor))
    return FocalLength(
        _with_factor(projector, log_factor),
        factor,
        factor * sigma,
        (before, _noise(poses, rays, settings)),
        abs(factor - 1) > settings.significant_sigmas * factor * sigma,
    )


def _normal(pose: UnitPose, rays: RayPairs, around: tuple[RayPairs, RayPairs], width: float, h: float) -> _Normal:
    """`around`: the same correspondences with the logarithm of the focal length larger and smaller by `h`."""
    r, J = sampson_jacobian(*pose, rays)
    ahead, behind = (sampson(*pose, side) for side in around)
    j = (ahead - behind) / (2 * h)
    w = geman_mcclure_weight((r / width) ** 2)
    A = (J * w[:, None]).T @ J
    slope = np.linalg.lstsq(A, J.T @ (w * j), rcond=1e-13)[0]
    unexplained = j - J @ slope  # what the frame's own pose cannot explain
    return _Normal(
        float(w @ unexplained**2),
        float((w * unexplained) @ r),
        rays.block_sums(w * r * unexplained),
        -np.linalg.lstsq(A, J.T @ (w * r), rcond=1e-13)[0],
        slope,
    )


def _with_factor(projector: Device, log_factor: float) -> Device:
    factor = float(np.exp(log_factor))
    return replace(projector, fl_x=projector.fl_x * factor, fl_y=projector.fl_y * factor)


def _rays(frame: PosedFrame, index: Int64[ndarray, "m"], projector: Device, settings: FocalSettings) -> RayPairs:
    rays, usable = ray_pairs(
        frame.uv_camera[index], frame.uv_projector[index], frame.camera, projector, settings.blocks
    )
    if len(usable) < len(index):
        raise UserError(
            "with the refined focal length some coordinates leave a DOE's range\n    remedy: check the stated one"
        )
    return rays


def _noise(poses: Sequence[UnitPose], rays: Sequence[RayPairs], settings: FocalSettings) -> float:
    residuals = [sampson(*pose, own) for pose, own in zip(poses, rays, strict=True)]
    return noise_of(np.concatenate(residuals), settings.fit.noise_floor_px)
