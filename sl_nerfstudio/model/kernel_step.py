"""The losses of a training step by kernels for GPUs, from the poses' parameters to the gradients of all of them."""

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from sl_nerfstudio.dataparser.samples import PixelSamples
from sl_nerfstudio.device_kernels import launch
from sl_nerfstudio.model.model import SLModel
from sl_nerfstudio.model.pose_parameters import PoseParameters
from sl_nerfstudio.model.warp_kernels import poses as kernels
from sl_nerfstudio.rendering.device_step import Current, Devices, Pixels, Step, step_losses


def kernel_step(
    model: SLModel, samples: PixelSamples, index: Int[Tensor, "rays"]
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Weighted losses and metrics of the pixels `index` (see `SLPixelSampler.choose`), as the model computes them."""
    none = index.new_empty(0, dtype=torch.int32)
    among = none if index.device.type == "cpu" else samples.training
    pixels = Pixels(index, among, samples.frame, samples.row, samples.column, samples.coords, samples.pattern)
    scalars = (model.kappa_now, model.surface_width_now, model.noise_px, model.px_per_length)
    devices = Devices(model.cameras, model.projector, model.pattern)
    c = model.config
    step = Step(pixels, devices, Current(*scalars), model.cache.values, c.sampling, c.losses, model.renders_now)
    found = step_losses(model.field, step, *device_poses(model.device_poses))
    metrics = {"coordinate_px": found.coordinate_px, "pattern_cosine": found.pattern_cosine}
    return found.terms, {name: value for name, value in metrics.items() if value is not None}


def device_poses(poses: PoseParameters) -> tuple[Float[Tensor, "frames 4 4"], Float[Tensor, "frames 4 4"]]:
    """`T_scene_camera` and `T_scene_projector` of all frames in float32, differentiable by the increments."""
    kind = (int(poses.about_scene), ("nothing", "relative pose", "own pose").index(poses.projector_moves_by))
    return _Poses.apply(kind, poses.camera_step, poses.projector_step, poses.base_camera, poses.base_projector)


class _Poses(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, kind: tuple[int, int], *tensors: Tensor) -> tuple[Tensor, Tensor]:
        ctx.kind = kind
        ctx.save_for_backward(*tensors)
        camera, projector = tensors[0].new_empty(2, len(tensors[0]), 4, 4)
        launch(kernels.poses, len(camera), *tensors, *kind, camera, projector)
        return camera, projector

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> Any:
        tensors = ctx.saved_tensors
        shared = len(tensors[1]) < len(tensors[0])
        d_camera, d_projector = (
            torch.empty_like(tensors[0]),
            (torch.zeros_like if shared else torch.empty_like)(tensors[1]),
        )
        upstream = (x.contiguous() for x in grad_outputs)
        launch(kernels.poses_adjoint, len(d_camera), *tensors, *ctx.kind, *upstream, d_camera, d_projector)
        moves = ctx.kind[1] != 0
        return None, d_camera, d_projector if moves else None, None, None
