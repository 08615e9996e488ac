"""Poses of the cameras and projectors of all frames."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.similarity import Similarity


@dataclass(frozen=True)
class DevicePoses:
    """Camera and projector poses of all frames, device to world; NaN where a frame has none."""

    T_world_camera: Float64[ndarray, "n 4 4"]
    T_world_projector: Float64[ndarray, "n 4 4"]

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.T_world_camera)

    def __getitem__(self, frames: Sequence[int] | slice | ndarray) -> "DevicePoses":
        """The poses of some frames."""
        return DevicePoses(self.T_world_camera[frames], self.T_world_projector[frames])

    @property
    def T_camera_projector(self) -> Float64[ndarray, "n 4 4"]:
        """Pose of each projector in the axes of its camera."""
        return np.linalg.inv(self.T_world_camera) @ self.T_world_projector

    @property
    def baseline(self) -> Float64[ndarray, "n"]:
        """Distance between camera and projector of each frame."""
        return np.linalg.norm(self.T_world_camera[:, :3, 3] - self.T_world_projector[:, :3, 3], axis=1)

    def stacked(self) -> Float64[ndarray, "m 4 4"]:
        """Cameras, then projectors."""
        return np.concatenate([self.T_world_camera, self.T_world_projector])

    def mapped(self, S_target_world: Similarity) -> "DevicePoses":
        """The same devices in other axes and another unit; orientations stay rotations."""
        return DevicePoses(S_target_world.poses(self.T_world_camera), S_target_world.poses(self.T_world_projector))
