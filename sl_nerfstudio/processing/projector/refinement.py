"""The projector's intrinsics refined by the joint adjustment: what is known of them before is the prior."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.free_parameters import RefinePoses
from sl_nerfstudio.bundle_adjustment.registered_frames import ProjectorKnowledge, RegisteredFramesSettings
from sl_nerfstudio.bundle_adjustment.self_calibration import SelfCalibration
from sl_nerfstudio.calibration.stated_sigma import Shares
from sl_nerfstudio.geometry.devices import Device, DeviceChange
from sl_nerfstudio.processing.config import Rig
from sl_nerfstudio.processing.consistency import ConsistentFrames, adjust_consistent
from sl_nerfstudio.processing.kept.large_clouds import LargeClouds
from sl_nerfstudio.processing.projector.found import FoundProjector
from sl_nerfstudio.registration.frame_cloud import FrameCloud
from sl_nerfstudio.registration.result import Registration
from sl_nerfstudio.relative_pose.estimation import relative_pose_near
from sl_nerfstudio.relative_pose.ray_pairs import correspondences_of

_ROUNDS = 3
_NEGLIGIBLE = 0.5  # chi square of three values: the change is well within its uncertainty


@dataclass(frozen=True)
class RefinedProjector:
    """Everything that follows from the projector, as the joint adjustment leaves it."""

    clouds: Sequence[FrameCloud]
    consistent: ConsistentFrames
    found: FoundProjector


_MOVES: dict[Rig, RefinePoses] = {"free": "free", "rigid": "rigid-rig", "static-projector": "static-projector"}


def adjustment_settings(rig: Rig, found: FoundProjector | None) -> RegisteredFramesSettings:
    """The joint adjustment for a kind of rig, with the uncertainty of a projector that was found."""
    return RegisteredFramesSettings(refine=_MOVES[rig], projector=None if found is None else knowledge(found))


def knowledge(found: FoundProjector, projector: Device | None = None) -> ProjectorKnowledge:
    """The prior for the adjustment; `projector`: the current one, if it was changed since."""
    a, b, c = found.sigma_share.tolist()
    known, now = found.projector, projector or found.projector
    change = DeviceChange(now.fl_x / known.fl_x - 1, (now.cx - known.cx) / known.fl_x, (now.cy - known.cy) / known.fl_x)
    return ProjectorKnowledge((a, b, c), change)


def refine_projector(
    clouds: Sequence[FrameCloud],
    consistent: ConsistentFrames,
    found: FoundProjector,
    camera_sigma: Shares,
    settings: RegisteredFramesSettings,
    log: Callable[[str], None],
) -> RefinedProjector:
    """Gauss-Newton steps of focal length and principal point, with all poses adjusted again after each.

    A step is kept if less of a contradiction is left than before. `camera_sigma`: how uncertain the camera is; what
    follows from it is part of the projector's uncertainty.
    """
    projector, covariance = found.projector, None  # None: no step was taken
    for _ in range(_ROUNDS):
        calibration = consistent.adjusted.intrinsics
        if calibration is None or not calibration.known:
            break
        step, _ = calibration.of_projector()
        chi_square = _chi_square(calibration)
        if chi_square < _NEGLIGIBLE:
            break
        new = DeviceChange(*step.tolist()).applied(projector)
        new_clouds = with_projector(clouds, consistent, new)
        again = adjust_consistent(
            new_clouds,
            at_adjusted_poses(consistent),
            log,
            replace(settings, projector=knowledge(found, new)),
        )
        left = again.adjusted.intrinsics
        if left is None or not left.known or _chi_square(left) >= chi_square:
            break
        clouds, consistent, projector, covariance = new_clouds, again, new, _covariance(left, camera_sigma, settings)
    return RefinedProjector(clouds, consistent, _with_sigma(found, projector, covariance))


def _chi_square(calibration: SelfCalibration) -> float:
    """Of the change of the projector alone that would agree best: about three if nothing is wrong."""
    step, uncertainty = calibration.of_projector()
    return float(step @ torch.linalg.solve(uncertainty, step))


def _covariance(
    calibration: SelfCalibration, camera_sigma: Shares, settings: RegisteredFramesSettings
) -> Float[Tensor, "3 3"]:
    """Of the projector: by errors of neighbouring pixels that depend on each other, and by an uncertain camera."""
    return settings.dependence**2 * calibration.of_projector()[1] + calibration.projector_by_camera(camera_sigma)


def _with_sigma(found: FoundProjector, projector: Device, covariance: Float[Tensor, "3 3"] | None) -> FoundProjector:
    """The refined values; their uncertainty never exceeds that of the start.

    It stays that of the start where aspect or k1 were found, too: the adjustment takes them as exact.
    """
    if covariance is None:
        return found
    if found.sigma[4] > 0 or found.sigma[1] != found.sigma[0]:
        return replace(found, projector=projector)
    shares = np.sqrt(covariance.diagonal().clamp_min(0).numpy())
    focal, x, y = np.minimum(shares, found.sigma_share) * projector.fl_x
    return replace(found, projector=projector, sigma=(float(focal), float(focal), float(x), float(y), 0.0))


def with_projector(clouds: Sequence[FrameCloud], consistent: ConsistentFrames, projector: Device) -> list[FrameCloud]:
    """The clouds with another projector: their poses follow, from the adjusted ones where there are such."""
    poses, kept = consistent.adjusted.poses, LargeClouds()
    out = []
    for k, cloud in enumerate(clouds):
        T = poses.T_camera_projector[k] if consistent.registration.registered[k] else cloud.pose.T_camera_projector
        pose = relative_pose_near(T, *correspondences_of(cloud.coords), cloud.camera, projector)
        out.append(kept.kept(cloud.with_pose(projector, pose)))
    return out


def at_adjusted_poses(consistent: ConsistentFrames) -> Registration:
    """The registration with the adjusted cameras and baselines."""
    poses = consistent.adjusted.poses
    return replace(consistent.registration, T_world_camera=poses.T_world_camera, baseline=poses.baseline)
