"""From a registration to a scan's poses: bundle adjustment of all registered frames, in the registration's gauge."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.bundle_adjustment.adjust import Adjustment, find_minimum, with_other_minima
from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.covariance import frame_sigmas
from sl_nerfstudio.bundle_adjustment.modes import Mode
from sl_nerfstudio.bundle_adjustment.parameters import (
    PosePrior,
    RefinePoses,
    SelfCalibration,
    baseline_scale,
    constrained,
    restore,
)
from sl_nerfstudio.bundle_adjustment.residuals import Rig
from sl_nerfstudio.bundle_adjustment.search import AdjustmentSettings
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import DeviceChange, IntrinsicsChange
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity, centred_on
from sl_nerfstudio.registration.result import Registration
from sl_nerfstudio.registration.surfaces import FrameCloud, motion_by_pose_errors
from sl_nerfstudio.scan.types import PoseSigma

# Errors after a registration, 1 sigma.
_FRAME_ROTATION_DEG = 1.0  # about each axis
_TONED_ROTATION_DEG = 0.5  # of a frame that tones hold where its surface would let it slip: the adjustment lets it, too
_FRAME_TRANSLATION = 0.03  # share of the object's radius
_BASELINE_LENGTH = 0.02  # of the logarithm
_LEAST_RELATIVE_ROTATION_DEG = 0.02  # a frame's own covariance does not include wrong intrinsics

# Factor on the stated sigma: look-ups share pixels, cells and edges, and errors on synthetic scans are about twice as
# large as independent residuals suggest.
DEPENDENCE = 2.0
_LEAST_SIGMA = 1e-9  # smallest sigma that is stated, scene units or radian


@dataclass(frozen=True)
class ProjectorKnowledge:
    """Prior knowledge of the projector's focal length and principal point: shares of the focal length."""

    sigma: tuple[float, float, float]
    change: DeviceChange = field(default_factory=DeviceChange)  # of the current projector against the known one


@dataclass(frozen=True)
class RegisteredFramesSettings:
    """Bundle adjustment after a registration by surfaces."""

    refine: RefinePoses = "free"
    """What moves: every device, frames with one relative pose for all, or frames under one projector that stays."""
    projector: ProjectorKnowledge | None = None
    """Uncertainty of a projector that was found from the captures; None: that of any calibration."""
    adjustment: AdjustmentSettings = field(default_factory=lambda: AdjustmentSettings(further_searches=False))
    """The bundle adjustment itself; surfaces were registered before."""


@dataclass(frozen=True)
class AdjustedFrames:
    """Poses of all frames with 1 sigma; NaN and None where a frame was not registered.

    Noise and residuals are NaN if the frames were registered only.
    """

    poses: DevicePoses
    sigma: tuple[PoseSigma | None, ...]  # of the frame as a whole, and of projector against camera; per axis
    noise_px: float  # of one look-up, projector pixels
    median_before_px: float  # cross-frame residual before the adjustment
    median_after_px: float
    intrinsics: SelfCalibration | None  # None where nothing was adjusted
    modes: tuple[Mode, ...] = ()  # other poses that remain possible, the most probable first

    def mapped(self, S_target_world: Similarity) -> "AdjustedFrames":
        """The same frames in other axes and another unit."""
        f = S_target_world.scale
        sigma = [
            s and PoseSigma(s.camera_translation * f, s.camera_rotation_deg, s.relative_translation * f,
                            s.relative_rotation_deg)
            for s in self.sigma
        ]  # fmt: skip
        modes = tuple(mode.turned(S_target_world.R) for mode in self.modes)
        return replace(self, poses=self.poses.mapped(S_target_world), sigma=tuple(sigma), modes=modes)

    def scaled(self, factor: float) -> "AdjustedFrames":
        """The same frames with all lengths multiplied."""
        return self.mapped(Similarity.scaling(factor))


@dataclass(frozen=True)
class RegisteredMinimum:
    """Adjustment of all registered frames, of which it is not known yet whether it is one of several minima."""

    frames: AdjustedFrames  # with the sigma of this minimum alone
    adjustment: Adjustment
    unit: float  # of the scene, in that of the frames

    def with_other_minima(self) -> AdjustedFrames:
        """Let sigma cover how far other minima are, which takes several more searches; the poses stay."""
        index, found = np.flatnonzero([s is not None for s in self.frames.sigma]), with_other_minima(self.adjustment)
        sigma = _sigmas_among_all(_stated_sigma(found, self.unit), index.tolist(), len(self.frames.sigma))
        modes = tuple(replace(mode, frames=tuple(index[list(mode.frames)].tolist())) for mode in found.modes)
        return replace(self.frames, sigma=sigma, modes=modes)


def adjust_registered(
    clouds: Sequence[FrameCloud], registration: Registration, settings: RegisteredFramesSettings | None = None
) -> AdjustedFrames:
    """Adjust cameras and projectors of all registered frames together, from their coordinates.

    Raises UserError if fewer than two frames are registered.
    """
    return find_registered_minimum(clouds, registration, settings).with_other_minima()


def find_registered_minimum(
    clouds: Sequence[FrameCloud], registration: Registration, settings: RegisteredFramesSettings | None = None
) -> RegisteredMinimum:
    """Adjust without asking for other minima, where frames may be taken out again.

    Raises UserError if fewer than two frames are registered.
    """
    s = settings or RegisteredFramesSettings()
    index, total = _registered(clouds, registration), len(clouds)
    S_scene_world = _scene(clouds, registration, index)
    poses = _poses_of(clouds, registration, index)
    start = Rig.of([clouds[k].camera for k in index], clouds[0].projector, poses, S_scene_world)
    maps = CoordinateMaps.of(torch.from_numpy(clouds[k].coords) for k in index)
    prior = _prior(clouds, registration, index, S_scene_world.scale, s.projector)
    found = find_minimum(constrained(s.refine, start), maps, prior, s.refine, s.adjustment)
    S_world_scene = S_scene_world.inverse()
    rig = restore(start, found.rig, baseline_scale(start, found.rig, None))
    frames = AdjustedFrames(
        _among_all(rig.poses(S_world_scene), index, total),
        _sigmas_among_all(_stated_sigma(found, S_world_scene.scale), index, total),
        found.noise_px,
        found.median_before_px,
        found.median_after_px,
        found.intrinsics,
    )
    return RegisteredMinimum(frames, found, S_world_scene.scale)


def keep_registered(clouds: Sequence[FrameCloud], registration: Registration) -> AdjustedFrames:
    """The poses of all registered frames as registration left them, with what the adjustment takes as their prior.

    Raises UserError if fewer than two frames are registered.
    """
    index, total, nan = _registered(clouds, registration), len(clouds), float("nan")
    scale = _scene(clouds, registration, index).scale
    stated = frame_sigmas(_prior(clouds, registration, index, scale, None).sigma, 1 / scale)
    poses = _among_all(_poses_of(clouds, registration, index), index, total)
    return AdjustedFrames(poses, _sigmas_among_all(stated, index, total), nan, nan, nan, None)


def _registered(clouds: Sequence[FrameCloud], registration: Registration) -> list[int]:
    """Numbers of the registered frames. Raises UserError if fewer than two are."""
    index: list[int] = np.flatnonzero(registration.registered).tolist()
    if len(index) < 2:
        lost = ", ".join(exclusion.frame for exclusion in registration.exclusions)
        raise UserError(
            f"{len(index)} of {len(clouds)} frames could be registered; at least 2 are needed\n"
            f"    not registered: {lost}"
        )
    return index


def _poses_of(clouds: Sequence[FrameCloud], registration: Registration, index: Sequence[int]) -> DevicePoses:
    """Poses of some frames after registration."""
    camera, relative = registration.T_world_camera[list(index)], [clouds[k].pose.T_camera_projector for k in index]
    projector = np.stack(relative)
    projector[:, :3, 3] *= registration.baseline[list(index), None]
    return DevicePoses(camera, camera @ projector)


def _stated_sigma(found: Adjustment, unit: float) -> Float64[ndarray, "m 4"]:
    return DEPENDENCE * frame_sigmas(found.sigma.clamp_min(_LEAST_SIGMA), unit)


def _sigmas_among_all(
    stated: Float64[ndarray, "m 4"], index: Sequence[int], frames: int
) -> tuple[PoseSigma | None, ...]:
    """Sigma of some frames, at the indices of those frames among all; None elsewhere."""
    sigma: list[PoseSigma | None] = [None] * frames
    for k, values in zip(index, stated, strict=True):
        sigma[k] = PoseSigma(*values.tolist())
    return tuple(sigma)


def _among_all(poses: DevicePoses, index: Sequence[int], frames: int) -> DevicePoses:
    """Poses of some frames, at the indices of those frames among all; NaN elsewhere."""
    camera, projector = np.full((2, frames, 4, 4), np.nan)
    camera[index], projector[index] = poses.T_world_camera, poses.T_world_projector
    return DevicePoses(camera, projector)


def _scene(clouds: Sequence[FrameCloud], registration: Registration, index: Sequence[int]) -> Similarity:
    """World to scene: the object's centre becomes the origin, its radius one."""
    parts = []
    for k in index:
        T, some = registration.T_world_camera[k], clouds[k].points[:: max(1, len(clouds[k].points) // 500)]
        parts.append(registration.baseline[k] * some @ T[:3, :3].T + T[:3, 3])
    return centred_on(np.concatenate(parts), 2.0)


def _prior(
    clouds: Sequence[FrameCloud], registration: Registration, index: Sequence[int], scale: float,
    projector: ProjectorKnowledge | None,
) -> PosePrior:  # fmt: skip
    """Uncertainty of each frame after registration and relative pose estimation; scene units.

    Registration moves the surface into its place; where the pose's error has moved, turned and scaled the surface as a
    whole, that puts the camera off.
    """
    rows = []
    toned = {name for edge in registration.edges if edge.used and edge.by_tone for name in edge.frames}
    for k in index:
        pose, length = clouds[k].pose, registration.baseline[k] * scale
        direction = np.sqrt(np.trace(pose.covariance[3:, 3:]) / 2)
        turn = float(np.sqrt(np.trace(pose.covariance[:3, :3]) / 3))
        motion = motion_by_pose_errors(clouds[k])
        camera_shift = motion[:3] - np.outer(clouds[k].centroid, motion[6])
        growth = float(np.linalg.norm(motion[6]))
        turn_deg = _TONED_ROTATION_DEG if registration.names[k] in toned else _FRAME_ROTATION_DEG
        rows.append(
            (
                float(np.hypot(_FRAME_TRANSLATION, length * np.linalg.norm(camera_shift) / 3**0.5)),
                float(np.hypot(np.radians(turn_deg), np.linalg.norm(motion[3:6]) / 3**0.5)),
                length * float(np.linalg.norm([_BASELINE_LENGTH, growth, direction])),
                max(turn, np.radians(_LEAST_RELATIVE_ROTATION_DEG)),
            )
        )
    a, b, c, d = torch.tensor(rows, dtype=torch.float64).unbind(1)
    if projector is None:
        return PosePrior(a, b, c, d)
    change = IntrinsicsChange(projector=projector.change)
    return PosePrior(a, b, c, d, intrinsics_change=change, projector_intrinsics=projector.sigma)
