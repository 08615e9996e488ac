"""Errors of camera and projector poses against the true ones."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from sl_nerfstudio.evaluation.alignment import align_poses
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
    """Errors after one common similarity has brought all estimated devices onto the true ones."""

    camera: DeviceErrors
    projector: DeviceErrors
    relative: DeviceErrors  # projector as seen from its own camera; needs no alignment but the scale
    scale_error: float  # estimated lengths are 1 + scale_error times the true ones
    S_truth_estimate: Similarity


def compare_poses(
    T_world_camera: Float[ndarray, "n 4 4"],
    T_world_projector: Float[ndarray, "n 4 4"],
    true_T_world_camera: Float[ndarray, "n 4 4"],
    true_T_world_projector: Float[ndarray, "n 4 4"],
) -> PoseErrors:
    """Errors of all poses. The gauge (where the world lies, how it is turned, its scale) is no error.

    One map is fitted to all camera and projector centres and orientations together, so what is left
    are contradictions between the poses; the scale it finds is reported apart.
    """
    estimated = np.concatenate([T_world_camera, T_world_projector])
    true = np.concatenate([true_T_world_camera, true_T_world_projector])
    S = align_poses(estimated, true)
    relative = np.linalg.inv(T_world_camera) @ T_world_projector
    relative[:, :3, 3] *= S.scale
    return PoseErrors(
        camera=device_errors(S.poses(T_world_camera), true_T_world_camera),
        projector=device_errors(S.poses(T_world_projector), true_T_world_projector),
        relative=device_errors(relative, np.linalg.inv(true_T_world_camera) @ true_T_world_projector),
        scale_error=1 / S.scale - 1,
        S_truth_estimate=S,
    )


def device_errors(T: Float[ndarray, "n 4 4"], true_T: Float[ndarray, "n 4 4"]) -> DeviceErrors:
    """Distance of the centres and angle between the orientations, frame by frame."""
    turn = torch.as_tensor(np.swapaxes(true_T[:, :3, :3], -1, -2) @ T[:, :3, :3], dtype=torch.float64)
    return DeviceErrors(
        translation=np.linalg.norm(T[:, :3, 3] - true_T[:, :3, 3], axis=1),
        rotation_deg=np.degrees(log_so3(turn).norm(dim=-1).numpy()),
    )
