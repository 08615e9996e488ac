"""Poses of all devices as parameters, in the scene frame: increments to a base.

The bundle adjustment may replace the base before training continues.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sl_nerfstudio.bundle_adjustment.covariance import JointCovariance, as_stored, stored_columns
from sl_nerfstudio.bundle_adjustment.parameters import UNKNOWNS, SelfCalibration
from sl_nerfstudio.geometry.lie import exp_se3, exp_so3, inverse, pose

PoseMode = Literal["off", "SO3xR3", "SE3"]
ProjectorMoves = Literal["nothing", "relative pose", "own pose"]


@dataclass(frozen=True)
class PoseOptimizerConfig:
    """How the rendering losses move the poses of one kind of device, under the names that nerfstudio has for it."""

    mode: PoseMode | None = None
    """Six numbers move each pose: `SE3` (the exponential of a twist), `SO3xR3` (a rotation vector, and a translation
    apart from it) or `off` (poses stay as they are); left out: `SE3` where the losses move poses."""

    @property
    def used(self) -> PoseMode:
        """The mode where the losses move poses."""
        return self.mode or "SE3"


NOT_STATED = PoseOptimizerConfig()


def increments(mode: PoseMode, steps: Float[Tensor, "n 6"]) -> Float[Tensor, "n 4 4"]:
    """The rigid motions of steps (translation, rotation vector in radian); none for `off`."""
    if mode == "SE3":
        return exp_se3(steps)
    moves = steps if mode == "SO3xR3" else torch.zeros_like(steps)
    return pose(exp_so3(moves[:, 3:]), moves[:, :3])


@dataclass(frozen=True)
class FrameTransforms:
    """What rays need of the current poses, in float32."""

    T_scene_camera: Float[Tensor, "frames 4 4"]
    correction: Float[Tensor, "frames 4 4"]  # from the starting pose of the camera, at which rays are made
    T_scene_projector: Float[Tensor, "frames 4 4"]
    T_projector_scene: Float[Tensor, "frames 4 4"]


class PoseParameters(nn.Module):
    """Base poses (float64 buffers, saved with the weights) and increments to them."""

    start_camera: Tensor
    start_projector: Tensor
    base_camera: Tensor
    base_projector: Tensor
    sigma: Tensor
    intrinsics_change: Tensor
    intrinsics_covariance: Tensor
    joint_factor: Tensor
    unplaced: Tensor

    def __init__(
        self,
        T_scene_camera: Float[Tensor, "frames 4 4"],
        T_scene_projector: Float[Tensor, "frames 4 4"],
        refine: bool,
        refine_projector: bool = True,
        shared_projector: bool = False,
        about_scene: bool = True,
        projector_moves_by: ProjectorMoves = "relative pose",
        modes: tuple[PoseMode, PoseMode] = ("SE3", "SE3"),
    ) -> None:
        """Parameters that the losses move if `refine`; `modes` of cameras and projectors.

        Cameras turn about the scene's centre, or each about its own. `projector_moves_by` is what the projector's
        increment changes, and `shared_projector` makes it one increment for all frames.
        """
        super().__init__()
        self.about_scene, self.projector_moves_by, self.modes = about_scene, projector_moves_by, modes
        for name, T in (("camera", T_scene_camera), ("projector", T_scene_projector)):
            self.register_buffer(f"start_{name}", T.double().clone())
            self.register_buffer(f"base_{name}", T.double().clone())
        n = len(T_scene_camera)
        # 1 sigma of (delta, rho): translation xyz, rotation xyz each; NaN where not estimated
        self.register_buffer("sigma", torch.full((n, 12), float("nan"), dtype=torch.float64))
        # the adjustment's self-calibration of the intrinsics (see SelfCalibration); NaN where there is none
        self.register_buffer("intrinsics_change", torch.full((UNKNOWNS,), float("nan"), dtype=torch.float64))
        covariance = torch.full((UNKNOWNS, UNKNOWNS), float("nan"), dtype=torch.float64)
        self.register_buffer("intrinsics_covariance", covariance)
        # of the covariance of all poses and the intrinsics, see JointCovariance; NaN where not estimated
        size = 12 * n + UNKNOWNS
        joint = torch.full((size, stored_columns(size)), float("nan"), dtype=torch.float64)
        self.register_buffer("joint_factor", joint)
        self.register_buffer("unplaced", torch.zeros(n, dtype=torch.bool))  # frames that disagree with the others
        self.camera_step = nn.Parameter(torch.zeros(n, 6), requires_grad=refine and modes[0] != "off")
        moves = refine and refine_projector and modes[1] != "off"
        self.projector_step = nn.Parameter(torch.zeros(1 if shared_projector else n, 6), requires_grad=moves)
        self._fixed: FrameTransforms | None = None
        self.register_load_state_dict_post_hook(_forget)

    @torch.no_grad()
    def rebase(
        self, T_scene_camera: Float[Tensor, "frames 4 4"], T_scene_projector: Float[Tensor, "frames 4 4"]
    ) -> None:
        """Continue from other poses; the increments become zero."""
        self.base_camera.copy_(T_scene_camera)
        self.base_projector.copy_(T_scene_projector)
        self.camera_step.zero_()
        self.projector_step.zero_()
        self._fixed = None

    @torch.no_grad()
    def note(
        self,
        sigma: Float[Tensor, "frames 12"],
        factor: Float[Tensor, "joint k"],
        intrinsics: SelfCalibration | None,
        unplaced: Sequence[int] = (),
    ) -> None:
        """Store the adjustment's results other than the poses."""
        self.sigma.copy_(sigma)
        self.joint_factor.copy_(as_stored(factor))
        self.unplaced.zero_()
        self.unplaced[list(unplaced)] = True
        if intrinsics is not None:
            self.intrinsics_change.copy_(intrinsics.change)
            self.intrinsics_covariance.copy_(intrinsics.covariance)

    def self_calibration(self) -> SelfCalibration | None:
        """The adjustment's self-calibration of the intrinsics; None if nothing was adjusted."""
        found = SelfCalibration(self.intrinsics_change.cpu(), self.intrinsics_covariance.cpu())
        return found if found.known else None

    def joint_covariance(self) -> JointCovariance | None:
        """The covariance of all poses and the intrinsics in the scene; None if it was not estimated."""
        if bool(self.joint_factor.isnan().any()):
            return None
        return JointCovariance(self.joint_factor.cpu().numpy())

    def forward(self) -> tuple[Float[Tensor, "frames 4 4"], Float[Tensor, "frames 4 4"]]:
        """`T_scene_camera` and `T_scene_projector` of all frames, float64, differentiable."""
        camera = self.base_camera
        if self.modes[0] != "off":
            step = increments(self.modes[0], self.camera_step.double())
            camera = step @ self.base_camera if self.about_scene else self.base_camera @ step
        if self.projector_moves_by == "nothing" or self.modes == ("off", "off"):
            return camera, self.base_projector
        step = increments(self.modes[1], self.projector_step.double())
        if self.projector_moves_by == "own pose":
            return camera, self.base_projector @ step
        return camera, camera @ (step @ inverse(self.base_camera) @ self.base_projector)

    @property
    def move(self) -> bool:
        """Whether the losses move any of them."""
        return self.camera_step.requires_grad or self.projector_step.requires_grad

    def transforms(self) -> FrameTransforms:
        """The current poses as rays need them, differentiable; computed once if no losses move the poses."""
        if self.move:
            return self._transforms()
        if self._fixed is None:
            with torch.inference_mode(False), torch.no_grad():
                self._fixed = self._transforms()
        return self._fixed

    def _transforms(self) -> FrameTransforms:
        camera, projector = self()
        correction = (camera @ inverse(self.start_camera)).float()
        return FrameTransforms(camera.float(), correction, projector.float(), inverse(projector).float())

    def _apply(self, fn: Any, recurse: bool = True) -> Any:
        self._fixed = None  # torch moves parameters and buffers to another device
        return super()._apply(fn, recurse)


def _forget(parameters: PoseParameters, _: object) -> None:
    """After a checkpoint was loaded."""
    parameters._fixed = None
