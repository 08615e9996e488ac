"""Poses of all devices as parameters, in the scene frame.

`RigPoseParameters` (ours): a frame moves as a whole, and its projector moves against its camera.
`StaticProjectorParameters`: cameras move about a projector that does not.
`IndependentPoseParameters` (the paper's): camera and projector of a frame know nothing of each other.

Both start from a *base* that may be replaced (by the joint adjustment) before training goes on; the
parameters are increments to it, in units of `step`, so that one learning rate suits all of them.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sl_nerfstudio.geometry.se3 import exp_se3, inverse


class PoseParameters(nn.Module):
    """Base poses (float64 buffers, saved with the weights) and increments to them."""

    start_camera: Tensor
    start_projector: Tensor
    base_camera: Tensor
    base_projector: Tensor
    sigma: Tensor
    intrinsics_change: Tensor
    intrinsics_covariance: Tensor

    def __init__(
        self,
        T_scene_camera: Float[Tensor, "frames 4 4"],
        T_scene_projector: Float[Tensor, "frames 4 4"],
        refine_camera: bool,
        refine_projector: bool,
        shared_projector: bool = False,
    ) -> None:
        super().__init__()
        for name, T in (("camera", T_scene_camera), ("projector", T_scene_projector)):
            self.register_buffer(f"start_{name}", T.double().clone())
            self.register_buffer(f"base_{name}", T.double().clone())
        n = len(T_scene_camera)
        # posterior 1 sigma of (delta, rho): translation xyz, rotation xyz each; NaN where not estimated
        self.register_buffer("sigma", torch.full((n, 12), float("nan"), dtype=torch.float64))
        # what the adjustment says of the intrinsics (see IntrinsicsDoubt); NaN where nothing
        self.register_buffer("intrinsics_change", torch.full((6,), float("nan"), dtype=torch.float64))
        self.register_buffer("intrinsics_covariance", torch.full((6, 6), float("nan"), dtype=torch.float64))
        self.camera_step = nn.Parameter(torch.zeros(n, 6), requires_grad=refine_camera)
        self.projector_step = nn.Parameter(torch.zeros(1 if shared_projector else n, 6), requires_grad=refine_projector)

    @torch.no_grad()
    def rebase(
        self, T_scene_camera: Float[Tensor, "frames 4 4"], T_scene_projector: Float[Tensor, "frames 4 4"]
    ) -> None:
        """Go on from other poses; the increments become zero."""
        self.base_camera.copy_(T_scene_camera)
        self.base_projector.copy_(T_scene_projector)
        self.camera_step.zero_()
        self.projector_step.zero_()

    def forward(self) -> tuple[Float[Tensor, "frames 4 4"], Float[Tensor, "frames 4 4"]]:
        """`T_scene_camera` and `T_scene_projector` of all frames, float64, differentiable."""
        raise NotImplementedError


class RigPoseParameters(PoseParameters):
    """`T_scene_camera = exp(delta) base` and `T_camera_projector = exp(rho) base`.

    delta rotates about the scene's centre.
    """

    def forward(self) -> tuple[Float[Tensor, "frames 4 4"], Float[Tensor, "frames 4 4"]]:
        """See Poses."""
        camera = exp_se3(self.camera_step.double()) @ self.base_camera
        relative = exp_se3(self.projector_step.double()) @ inverse(self.base_camera) @ self.base_projector
        return camera, camera @ relative


class StaticProjectorParameters(PoseParameters):
    """`T_scene_camera = exp(delta) base`, and a projector that stays where it is: only cameras move about it."""

    def forward(self) -> tuple[Float[Tensor, "frames 4 4"], Float[Tensor, "frames 4 4"]]:
        """See Poses."""
        return exp_se3(self.camera_step.double()) @ self.base_camera, self.base_projector


class IndependentPoseParameters(PoseParameters):
    """`T = base exp(xi)` for camera and projector apart: each turns about its own centre."""

    def forward(self) -> tuple[Float[Tensor, "frames 4 4"], Float[Tensor, "frames 4 4"]]:
        """See Poses."""
        return (
            self.base_camera @ exp_se3(self.camera_step.double()),
            self.base_projector @ exp_se3(self.projector_step.double()),
        )
