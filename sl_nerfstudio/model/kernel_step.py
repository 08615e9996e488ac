"""The losses of a training step by kernels for GPUs, from the poses' parameters to the gradients of all of them."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sl_nerfstudio.dataparser.datamanager import SLPixelSampler
from sl_nerfstudio.dataparser.dataparser import PixelSamples
from sl_nerfstudio.field.hash_grid import FEATURES
from sl_nerfstudio.field.triton_backend import step_table
from sl_nerfstudio.model.model import SLModel
from sl_nerfstudio.model.poses import PoseParameters
from sl_nerfstudio.rendering.triton_poses import Moves, moved_poses
from sl_nerfstudio.rendering.triton_step import Pixels, Step, step_losses


def kernel_step(
    model: SLModel, samples: PixelSamples, index: Int[Tensor, "rays"], renders: bool
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Weighted losses and metrics of the pixels `index` (see `SLPixelSampler.choose`), as the model computes them."""
    none = index.new_empty(0, dtype=torch.int32)
    among = none if index.device.type == "cpu" else samples.training
    pixels = Pixels(index, among, samples.frame, samples.row, samples.column, samples.coords, samples.pattern)
    devices = (model.cameras, model.projector, model.pattern)
    scalars = (model.kappa_now, model.surface_width_now, model.noise_px, model.px_per_length)
    c = model.config
    step = Step(pixels, *devices, *scalars, model.cache.values, c.sampling, c.losses, renders)
    return step_losses(model.field, step, *device_poses(model.device_poses))


def compile_kernels(model: SLModel, sampler: SLPixelSampler) -> None:
    """Compile all kernels of a training: by steps whose gradients are forgotten, and one of a table of zeros."""
    for renders in {model.renders_now, True}:
        terms, _ = kernel_step(model, sampler.samples, sampler.choose(0), renders)
        torch.stack(list(terms.values())).sum().backward()
    model.zero_grad(set_to_none=True)
    zeros = model.field.encoding.table.new_zeros
    rows = (zeros(16, FEATURES), zeros(16, FEATURES), zeros(16, 2, FEATURES), zeros(16))
    step_table(*rows, zeros(1), betas=(0.9, 0.99), most_steps=1, eps=1.0)


def device_poses(poses: PoseParameters) -> tuple[Float[Tensor, "frames 4 4"], Float[Tensor, "frames 4 4"]]:
    """`T_scene_camera` and `T_scene_projector` of all frames in float32, differentiable by the increments."""
    if not poses.camera_step.requires_grad or poses.modes != ("SE3", "SE3"):  # for which there is no kernel
        now = poses.transforms()
        return now.T_scene_camera, now.T_scene_projector
    by = poses.projector_moves_by
    moves = Moves(poses.about_scene, relative=by == "relative pose", own=by == "own pose")
    return moved_poses(moves, poses.camera_step, poses.projector_step, poses.base_camera, poses.base_projector)
