"""All devices of a scan as tensors in the scene frame, for solvers."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.loops.poses import inverse_poses, moved_poses
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.devices import Device, Intrinsics
from sl_nerfstudio.geometry.devices.models import MODELS
from sl_nerfstudio.geometry.se3 import inverse
from sl_nerfstudio.geometry.similarity import Similarity


@dataclass(frozen=True)
class Rig:
    """All devices of a scan; poses in the scene frame, whose origin is the centre of the object."""

    camera: Intrinsics  # batch (frames,)
    projector: Intrinsics  # batch ()
    T_world_camera: Float[Tensor, "frames 4 4"]
    T_camera_projector: Float[Tensor, "frames 4 4"]

    @staticmethod
    def of(cameras: Sequence[Device], projector: Device, poses: DevicePoses, S_scene_world: Similarity) -> "Rig":
        """Devices with the given poses in a world; the rig's "world" is the scene."""
        scene = poses.mapped(S_scene_world)
        camera = torch.from_numpy(scene.T_world_camera)
        return Rig(
            Intrinsics.of(list(cameras), torch.float64),
            Intrinsics.of(projector, torch.float64),
            camera,
            inverse(camera) @ torch.from_numpy(scene.T_world_projector),
        )

    def poses(self, S_world_scene: Similarity) -> DevicePoses:
        """Poses of all devices in a world."""
        return DevicePoses(self.T_world_camera.numpy(), self.T_world_projector.numpy()).mapped(S_world_scene)

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.T_world_camera)

    @cached_property
    def arrays(self) -> tuple[ndarray, ndarray, ndarray, ndarray, int, ndarray, int]:
        """For compiled loops: poses first, then parameters and model codes of cameras and projector.

        The poses are those of the cameras, their inverses, and those of the cameras in the axes of their projectors.
        """
        camera, projector = self.camera, self.projector
        T_world_camera, T_camera_projector, cameras, light = (
            np.ascontiguousarray(part.numpy())
            for part in (self.T_world_camera, self.T_camera_projector, camera.params, projector.params)
        )
        T_camera_world, T_projector_camera = np.empty_like(T_world_camera), np.empty_like(T_world_camera)
        inverse_poses(self.frames, T_world_camera, T_camera_world)
        inverse_poses(self.frames, T_camera_projector, T_projector_camera)
        codes = MODELS[camera.model].code, MODELS[projector.model].code
        return T_world_camera, T_camera_world, T_projector_camera, cameras, codes[0], light, codes[1]

    @property
    def T_world_projector(self) -> Float[Tensor, "frames 4 4"]:
        """Projector poses in the scene frame."""
        return self.T_world_camera @ self.T_camera_projector

    @property
    def baseline(self) -> Float[Tensor, "frames"]:
        """Distance between camera and projector of every frame."""
        return self.T_camera_projector[:, :3, 3].norm(dim=-1)

    def moved(self, delta: Float[Tensor, "frames 6"], rho: Float[Tensor, "frames 6"]) -> "Rig":
        """The rig after an increment of every frame as a whole, and of its projector relative to its camera."""
        return replace(
            self,
            T_world_camera=_after(delta, self.T_world_camera),
            T_camera_projector=_after(rho, self.T_camera_projector),
        )

    def scaled(self, scale: float) -> "Rig":
        """With all lengths multiplied."""
        camera, relative = self.T_world_camera.clone(), self.T_camera_projector.clone()
        camera[:, :3, 3] *= scale
        relative[:, :3, 3] *= scale
        return replace(self, T_world_camera=camera, T_camera_projector=relative)


def _after(twist: Float[Tensor, "n 6"], T: Float[Tensor, "n 4 4"]) -> Float[Tensor, "n 4 4"]:
    """exp(twist) T."""
    out = np.empty((len(T), 4, 4))
    moved_poses(len(T), np.ascontiguousarray(T.numpy()), np.ascontiguousarray(twist.numpy()), out)
    return torch.from_numpy(out)
