"""Errors of camera and projector poses against the true ones."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from sl_nerfstudio.evaluation.alignment import align_poses
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.se3 import log_so3
from sl_nerfstudio.geometry.similarity import Similarity


@dataclass(frozen=True)
class DeviceErrors:
    """Errors of one kind of device over all frames; lengths in the truth's unit."""

    translation: Float[ndarray, "n"]
    rotation_deg: Float[ndarray, "n"]

    @property
    def translation_rmse(self) -> float:
        """Root mean square of the frames' position errors."""
        return float(np.sqrt((self.translation**2).mean()))

    @property
    def rotation_rmse_deg(self) -> float:
        """Root mean square of the frames' rotation errors."""
        return float(np.sqrt((self.rotation_deg**2).mean()))


@dataclass(frozen=True)
class PoseErrors:
    """Errors after one common similarity has aligned all estimated devices with the true ones."""

    camera: DeviceErrors
    projector: DeviceErrors
    relative: DeviceErrors  # projector relative to the camera of its frame; needs no alignment except for the scale
    scale_error: float  # estimated lengths are 1 + scale_error times the true ones
    S_truth_estimate: Similarity


def compare_poses(estimated: DevicePoses, true: DevicePoses) -> PoseErrors:
    """Errors of all poses. The gauge (position, orientation and scale of the world) is not an error.

    One map is fitted to all camera and projector centres and orientations together. What remains are contradictions
    between the poses; the scale error is reported separately.
    """
    S = align_poses(estimated.stacked(), true.stacked())
    relative = estimated.T_camera_projector
    relative[:, :3, 3] *= S.scale
    aligned = estimated.mapped(S)
    return PoseErrors(
        camera=_device_errors(aligned.T_world_camera, true.T_world_camera),
        projector=_device_errors(aligned.T_world_projector, true.T_world_projector),
        relative=_device_errors(relative, true.T_camera_projector),
        scale_error=1 / S.scale - 1,
        S_truth_estimate=S,
    )


def _device_errors(T: Float[ndarray, "n 4 4"], true_T: Float[ndarray, "n 4 4"]) -> DeviceErrors:
    """Distance of the centres and angle between the orientations, frame by frame."""
    turn = torch.as_tensor(np.swapaxes(true_T[:, :3, :3], -1, -2) @ T[:, :3, :3], dtype=torch.float64)
    return DeviceErrors(
        translation=np.linalg.norm(T[:, :3, 3] - true_T[:, :3, 3], axis=1),
        rotation_deg=np.degrees(log_so3(turn).norm(dim=-1).numpy()),
    )
