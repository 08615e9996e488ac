"""What the viewer needs of a model."""

from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.joint_covariance.covariance import JointCovariance
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.scan import Scan


@runtime_checkable
class ViewedModel(Protocol):
    """A model that is trained, or was loaded."""

    scan: Scan
    S_scene_world: Similarity
    viewed_frame: int  # whose projector lights what is rendered from a free viewpoint

    @property
    def step(self) -> int:
        """The step of the training."""
        ...

    @property
    def device(self) -> torch.device:
        """Where the field is evaluated."""
        ...

    @property
    def cell(self) -> float:
        """Length of the field's finest cells, in the scan's unit."""
        ...

    def sdf(self, p_scene: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Signed distance in scene units."""
        ...

    def poses(self) -> DevicePoses:
        """Current poses in the scan's world and unit."""
        ...

    def poses_scene(self) -> tuple[Float[Tensor, "frames 4 4"], Float[Tensor, "frames 4 4"]]:
        """Current poses of cameras and projectors in the scene."""
        ...

    def joint_covariance(self) -> JointCovariance | None:
        """Covariance of all poses and the intrinsics in the scan's world and unit; None if it was not estimated."""
        ...

    def unplaced(self) -> list[bool]:
        """Of each frame, whether it does not agree with the others."""
        ...
