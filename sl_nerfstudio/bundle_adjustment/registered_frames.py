"""From a registration to a scan's poses: joint adjustment of all registered frames, in the registration's gauge."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.bundle_adjustment.adjust import AdjustmentSettings, adjust
from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.covariance import frame_sigmas
from sl_nerfstudio.bundle_adjustment.gauge import baseline_scale, restore
from sl_nerfstudio.bundle_adjustment.priors import PosePrior
from sl_nerfstudio.bundle_adjustment.residuals import Rig
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Intrinsics
from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.frame_cloud import FrameCloud
from sl_nerfstudio.registration.result import Registration
from sl_nerfstudio.scan.types import PoseSigma

# What registration by surfaces leaves, 1 sigma per axis: turns in radian, shifts in radii of the object.
_FRAME_ROTATION, _FRAME_TRANSLATION = np.radians(1.0), 0.03
_BASELINE_LENGTH = 0.02  # of the logarithm
# Neighbouring look-ups share pixels, cells and edges: on synthetic scans poses err by about twice what is stated.
_DEPENDENCE = 2.0
_LEAST_SIGMA = 1e-9  # scene units and radian: a scan states no sigma of zero
_LEAST_ROTATION = np.radians(0.02)  # of the projector: wrong intrinsics are not in the covariance of a frame


@dataclass(frozen=True)
class AdjustedFrames:
    """Poses (device to world) of all frames, with 1 sigma; NaN and None where a frame was not registered."""

    T_world_camera: Float64[ndarray, "n 4 4"]
    T_world_projector: Float64[ndarray, "n 4 4"]
    sigma: tuple[PoseSigma | None, ...]  # of the frame as a whole, and of projector against camera; per axis
    noise_px: float  # of one look-up, projector pixels
    median_before_px: float  # cross-frame residual before
    median_after_px: float
    intrinsics: str = ""  # what the captures say against the intrinsics

    def scaled(self, factor: float) -> "AdjustedFrames":
        """With all lengths multiplied: what makes a scan metric."""
        camera, projector = self.T_world_camera.copy(), self.T_world_projector.copy()
        camera[:, :3, 3] *= factor
        projector[:, :3, 3] *= factor
        sigma = tuple(
            None
            if s is None
            else PoseSigma(
                s.camera_translation * factor,
                s.camera_rotation_deg,
                s.relative_translation * factor,
                s.relative_rotation_deg,
            )
            for s in self.sigma
        )
        return replace(self, T_world_camera=camera, T_world_projector=projector, sigma=sigma)


def adjust_registered(
    clouds: Sequence[FrameCloud], registration: Registration, settings: AdjustmentSettings | None = None
) -> AdjustedFrames:
    """Adjust cameras and projectors of all registered frames together, from their coordinates.

    Raises UserError if fewer than two frames are registered.
    """
    index: list[int] = np.flatnonzero(registration.registered).tolist()
    if len(index) < 2:
        lost = ", ".join(exclusion.frame for exclusion in registration.exclusions)
        raise UserError(
            f"{len(index)} of {len(clouds)} frames could be registered; at least 2 are needed\n"
            f"    not registered: {lost}"
        )
    camera = registration.T_world_camera[index]
    projector = np.stack([_projector_pose(clouds[k], registration, k) for k in index])
    S_scene_world = _scene(clouds, registration, index)
    start = Rig(
        Intrinsics.of([clouds[k].camera for k in index], torch.float64),
        Intrinsics.of(clouds[0].projector, torch.float64),
        torch.from_numpy(S_scene_world.poses(camera)),
        torch.from_numpy(np.linalg.inv(camera) @ projector),
    )
    start.T_camera_projector[:, :3, 3] *= S_scene_world.scale
    maps = CoordinateMaps.of([torch.from_numpy(clouds[k].coords) for k in index])
    prior = _prior(clouds, registration, index, S_scene_world.scale)
    found = adjust(start, maps, prior, "free", settings or AdjustmentSettings())
    rig = restore(start, found.rig, baseline_scale(start, found.rig, None))
    S_world_scene = S_scene_world.inverse()
    n = len(clouds)
    T_camera, T_projector = np.full((n, 4, 4), np.nan), np.full((n, 4, 4), np.nan)
    T_camera[index] = S_world_scene.poses(rig.T_world_camera.numpy())
    T_projector[index] = S_world_scene.poses(rig.T_world_projector.numpy())
    sigma: list[PoseSigma | None] = [None] * n
    stated = _DEPENDENCE * frame_sigmas(found.sigma.clamp_min(_LEAST_SIGMA), S_world_scene.scale)
    for k, values in zip(index, stated, strict=True):
        sigma[k] = PoseSigma(*values.tolist())
    return AdjustedFrames(
        T_camera,
        T_projector,
        tuple(sigma),
        found.noise_px,
        found.median_before_px,
        found.median_after_px,
        ""
        if found.intrinsics is None
        else found.intrinsics.said([clouds[k].camera for k in index], clouds[0].projector),
    )


def _projector_pose(cloud: FrameCloud, registration: Registration, k: int) -> Float64[ndarray, "4 4"]:
    T = cloud.pose.T_camera_projector.copy()
    T[:3, 3] *= registration.baseline[k]
    return registration.T_world_camera[k] @ T


def _scene(clouds: Sequence[FrameCloud], registration: Registration, index: Sequence[int]) -> Similarity:
    """World to scene: the object's centre becomes the origin, its radius one."""
    parts = []
    for k in index:
        T, some = registration.T_world_camera[k], clouds[k].points[:: max(1, len(clouds[k].points) // 500)]
        parts.append(registration.baseline[k] * some @ T[:3, :3].T + T[:3, 3])
    p = np.concatenate(parts)
    low, high = np.percentile(p, [2, 98], axis=0)
    centre, radius = (low + high) / 2, float(np.linalg.norm(high - low) / 2)
    return Similarity(1 / radius, np.eye(3), -centre / radius)


def _prior(clouds: Sequence[FrameCloud], registration: Registration, index: Sequence[int], scale: float) -> PosePrior:
    """How well registration and auto-calibration know each frame; scene units."""
    rows = []
    for k in index:
        pose, length = clouds[k].pose, registration.baseline[k] * scale
        direction = np.sqrt(np.trace(pose.covariance[3:, 3:]) / 2)
        rows.append(
            (
                _FRAME_TRANSLATION,
                _FRAME_ROTATION,
                length * float(np.hypot(_BASELINE_LENGTH, direction)),
                max(float(np.sqrt(np.trace(pose.covariance[:3, :3]) / 3)), _LEAST_ROTATION),
            )
        )
    a, b, c, d = torch.tensor(rows, dtype=torch.float64).unbind(1)
    return PosePrior(a, b, c, d)
