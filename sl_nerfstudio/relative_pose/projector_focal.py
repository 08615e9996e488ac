"""The projector's focal length from the coordinates of all frames, where the stated one is only roughly right.

One unknown is common to all frames (a factor of fl_x and fl_y), five are each frame's own and are eliminated. A factor
of the focal length and a turn of the projector look much alike in a single frame; many frames tell them apart.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.relative_pose.epipolar_fit import (
    fit_epipolar,
    kernel_weight,
    moved,
    noise_of,
    sampson,
    sampson_jacobian,
)
from sl_nerfstudio.relative_pose.estimation import RelativePose
from sl_nerfstudio.relative_pose.ray_pairs import RayPairs, ray_pairs

_USED = 3000  # correspondences of each frame
_STEP = 1e-5  # of the logarithm, for differences
_ITERATIONS = 12
_CONVERGED = 1e-9
_KERNEL = 3.0
_LARGEST_STEP = 0.05


@dataclass(frozen=True)
class CalibratedView:
    """Correspondences of one frame and the pose that was found with the stated intrinsics."""

    uv_camera: Float64[ndarray, "n 2"]
    uv_projector: Float64[ndarray, "n 2"]
    camera: Device
    pose: RelativePose


@dataclass(frozen=True)
class FocalLength:
    """A projector with refined focal lengths, and whether that is better founded than the stated ones."""

    projector: Device
    factor: float  # refined over stated
    sigma: float  # 1 sigma of the factor; errors shared within squares of the pattern are allowed for
    residual_px: tuple[float, float]  # robust epipolar error of all frames, before and after

    @property
    def significant(self) -> bool:
        """Whether the stated value is more than three sigma off."""
        return abs(self.factor - 1) > 3 * self.sigma


def refine_projector_focal(views: Sequence[CalibratedView], projector: Device, seed: int = 0) -> FocalLength:
    """Focal length of the projector for which the epipolar errors of all frames together are smallest.

    Raises UserError without frames. Calibrate the frames again with the result.
    """
    if not views:
        raise UserError("no calibrated frame to find the projector's focal length from")
    rng = np.random.default_rng(seed)
    chosen = [_some(np.flatnonzero(v.pose.inliers), rng) for v in views]
    poses = [(v.pose.T_camera_projector[:3, :3], v.pose.T_camera_projector[:3, 3]) for v in views]
    value, sigma, before = 0.0, np.inf, None
    for _ in range(_ITERATIONS):
        rays = [_rays(v, index, projector, value) for v, index in zip(views, chosen, strict=True)]
        if before is None:
            before = _noise(poses, rays)
        noise = _noise(poses, rays)
        H = g = 0.0
        pulls, parts = [], []
        for (R, t), own, view, index in zip(poses, rays, views, chosen, strict=True):
            r, J = sampson_jacobian(R, t, own)
            ahead, behind = (_rays(view, index, projector, value + s) for s in (_STEP, -_STEP))
            j = (sampson(R, t, ahead) - sampson(R, t, behind)) / (2 * _STEP)
            w = kernel_weight(r, _KERNEL * noise)
            A = (J * w[:, None]).T @ J
            along = np.linalg.lstsq(A, J.T @ (w * j), rcond=1e-13)[0]
            alone = j - J @ along  # what the frame's own pose cannot explain
            H += float(w @ alone**2)
            g += float((w * alone) @ r)
            pulls.append(_block_sums(w * r * alone, own.block))
            parts.append((A, J.T @ (w * r), along))
        step = float(np.clip(-g / max(H, 1e-300), -_LARGEST_STEP, _LARGEST_STEP))
        value += step
        poses = [
            moved(R, t, -np.linalg.lstsq(A, own_g, rcond=1e-13)[0] - along * step)
            for (R, t), (A, own_g, along) in zip(poses, parts, strict=True)
        ]
        sigma = float(np.sqrt(sum((p**2).sum() for p in pulls)) / max(H, 1e-300))
        if abs(step) < _CONVERGED:
            break
    rays = [_rays(v, index, projector, value) for v, index in zip(views, chosen, strict=True)]
    poses = [(f.R, f.t) for f in (fit_epipolar(R, t, own, 10) for (R, t), own in zip(poses, rays, strict=True))]
    factor = float(np.exp(value))
    refined = replace(projector, fl_x=projector.fl_x * factor, fl_y=projector.fl_y * factor)
    return FocalLength(refined, factor, factor * sigma, (before or 0.0, _noise(poses, rays)))


def _some(index: ndarray, rng: np.random.Generator) -> ndarray:
    return index if len(index) <= _USED else rng.choice(index, _USED, replace=False)


def _rays(view: CalibratedView, index: ndarray, projector: Device, value: float) -> RayPairs:
    factor = float(np.exp(value))
    device = replace(projector, fl_x=projector.fl_x * factor, fl_y=projector.fl_y * factor)
    rays, usable = ray_pairs(view.uv_camera[index], view.uv_projector[index], view.camera, device)
    if len(usable) < len(index):
        raise UserError(
            "with the refined focal length some coordinates leave a DOE's range\n    remedy: check the stated one"
        )
    return rays


def _noise(poses: Sequence[tuple[ndarray, ndarray]], rays: Sequence[RayPairs]) -> float:
    return noise_of(np.concatenate([sampson(R, t, own) for (R, t), own in zip(poses, rays, strict=True)]))


def _block_sums(values: ndarray, block: ndarray) -> ndarray:
    return np.bincount(np.unique(block, return_inverse=True)[1], values)
