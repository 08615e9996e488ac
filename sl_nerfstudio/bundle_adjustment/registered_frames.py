"""From a registration to a scan's poses: bundle adjustment of all registered frames, in the registration's gauge."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.bundle_adjustment.adjust import Adjustment, Minimum, find_minimum
from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.covariance import frame_sigmas
from sl_nerfstudio.bundle_adjustment.parameters import (
    PosePrior,
    RefinePoses,
    SelfCalibration,
    baseline_scale,
    constrained,
    restore,
)
from sl_nerfstudio.bundle_adjustment.residuals import Rig
from sl_nerfstudio.bundle_adjustment.settings import AdjustmentSettings, HopSettings
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import DeviceChange, IntrinsicsChange
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity, centred_on
from sl_nerfstudio.registration.result import Registration
from sl_nerfstudio.registration.surfaces import FrameCloud, motion_by_pose_errors
from sl_nerfstudio.scan.types import PoseSigma


@dataclass(frozen=True)
class ProjectorKnowledge:
    """What is known of the projector's focal length and principal point: shares of the focal length."""

    sigma: tuple[float, float, float]
    change: DeviceChange = field(default_factory=DeviceChange)  # of the current projector against the known one


@dataclass(frozen=True)
class RegisteredFramesSettings:
    """Bundle adjustment after a registration by surfaces."""

    frame_rotation_deg: float = 1.0
    """Error of each frame's rotation after registration, 1 sigma per axis, in degrees."""
    toned_rotation_deg: float = 0.5
    """The same for a frame that tones hold where its surface would let it slip: the adjustment lets it slip, too."""
    frame_translation: float = 0.03
    """The same for its position, as a share of the object's radius."""
    baseline_length: float = 0.02
    """Error of a baseline's length after registration, 1 sigma of the logarithm."""
    least_relative_rotation_deg: float = 0.02
    """Smallest sigma of the relative rotation, in degrees: a frame's own covariance does not include wrong
    intrinsics."""
    dependence: float = 2.0
    """Factor on the stated sigma: look-ups share pixels, cells and edges, and errors on synthetic scans are about twice
    as large as independent residuals suggest."""
    least_sigma: float = 1e-9
    """Smallest sigma that is stated, in scene units or radian."""
    refine: RefinePoses = "free"
    """What moves: every device, frames with one relative pose for all, or frames under one projector that stays."""
    projector: ProjectorKnowledge | None = None
    """Uncertainty of a projector that was found from the captures; None: that of any calibration."""
    adjustment: AdjustmentSettings = field(
        default_factory=lambda: AdjustmentSettings(hops=HopSettings(lost_by_surface=False))
    )
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

    def mapped(self, S_target_world: Similarity) -> "AdjustedFrames":
        """In other axes and another unit."""
        factor = S_target_world.scale
        sigma = tuple(
            None
            if s is None
            else replace(
                s,
                camera_translation=s.camera_translation * factor,
                relative_translation=s.relative_translation * factor,
            )
            for s in self.sigma
        )
        return replace(self, poses=self.poses.mapped(S_target_world), sigma=sigma)

    def scaled(self, factor: float) -> "AdjustedFrames":
        """With all lengths multiplied, which makes a scan metric."""
        return self.mapped(Similarity.scaling(factor))


@dataclass(frozen=True)
class RegisteredMinimum:
    """Where the adjustment of all registered frames has ended."""

    frames: AdjustedFrames  # with the sigma of this minimum alone
    _minimum: Minimum
    _stated: Callable[[Adjustment], tuple[PoseSigma | None, ...]]

    def with_other_minima(self) -> AdjustedFrames:
        """The same poses; their sigma also covers how far other minima are, which takes several more searches."""
        return replace(self.frames, sigma=self._stated(self._minimum.with_other_minima()))


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
    """The same without asking for other minima, for frames of which some may be taken out.

    Raises UserError if fewer than two frames are registered.
    """
    s = settings or RegisteredFramesSettings()
    index = _registered(clouds, registration)
    S_scene_world = _scene(clouds, registration, index)
    start = Rig.of(
        [clouds[k].camera for k in index],
        clouds[0].projector,
        _poses_of(clouds, registration, index),
        S_scene_world,
    )
    maps = CoordinateMaps.of((torch.from_numpy(clouds[k].coords) for k in index), s.adjustment.look_up)
    prior = _prior(clouds, registration, index, S_scene_world.scale, s)
    minimum = find_minimum(constrained(s.refine, start), maps, prior, s.refine, s.adjustment)
    found, S_world_scene = minimum.adjustment, S_scene_world.inverse()
    rig = restore(start, found.rig, baseline_scale(start, found.rig, None))

    def stated(found: Adjustment) -> tuple[PoseSigma | None, ...]:
        sigma = s.dependence * frame_sigmas(found.sigma.clamp_min(s.least_sigma), S_world_scene.scale)
        return _sigmas_among_all(sigma, index, len(clouds))

    frames = AdjustedFrames(
        _among_all(rig.poses(S_world_scene), index, len(clouds)),
        stated(found),
        found.noise_px,
        found.median_before_px,
        found.median_after_px,
        found.intrinsics,
    )
    return RegisteredMinimum(frames, minimum, stated)


def keep_registered(
    clouds: Sequence[FrameCloud], registration: Registration, settings: RegisteredFramesSettings | None = None
) -> AdjustedFrames:
    """The poses of all registered frames as registration left them, with what the adjustment takes as their prior.

    Raises UserError if fewer than two frames are registered.
    """
    s = settings or RegisteredFramesSettings()
    index = _registered(clouds, registration)
    scale = _scene(clouds, registration, index).scale
    prior = _prior(clouds, registration, index, scale, s)
    shift, turn = prior.frame_translation / scale, torch.rad2deg(prior.frame_rotation)
    own_shift, own_turn = prior.relative_translation / scale, torch.rad2deg(prior.relative_rotation)
    stated = torch.stack([shift, turn, own_shift, own_turn], 1).numpy()
    return AdjustedFrames(
        _among_all(_poses_of(clouds, registration, index), index, len(clouds)),
        _sigmas_among_all(stated, index, len(clouds)),
        noise_px=float("nan"),
        median_before_px=float("nan"),
        median_after_px=float("nan"),
        intrinsics=None,
    )


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
    projector = np.stack([_projector_pose(clouds[k], registration, k) for k in index])
    return DevicePoses(registration.T_world_camera[list(index)], projector)


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
    return centred_on(np.concatenate(parts), 2.0)


def _prior(
    clouds: Sequence[FrameCloud],
    registration: Registration,
    index: Sequence[int],
    scale: float,
    settings: RegisteredFramesSettings,
) -> PosePrior:
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
        turn_deg = settings.toned_rotation_deg if registration.names[k] in toned else settings.frame_rotation_deg
        rows.append(
            (
                float(np.hypot(settings.frame_translation, length * np.linalg.norm(camera_shift) / 3**0.5)),
                float(np.hypot(np.radians(turn_deg), np.linalg.norm(motion[3:6]) / 3**0.5)),
                length * float(np.linalg.norm([settings.baseline_length, growth, direction])),
                max(turn, np.radians(settings.least_relative_rotation_deg)),
            )
        )
    a, b, c, d = torch.tensor(rows, dtype=torch.float64).unbind(1)
    if settings.projector is None:
        return PosePrior(a, b, c, d)
    known = settings.projector
    change = IntrinsicsChange(projector=known.change)
    return PosePrior(a, b, c, d, intrinsics_change=change, projector_intrinsics=known.sigma)
