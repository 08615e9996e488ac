# pyright: basic, reportGeneralTypeIssues=false, reportArgumentType=false
"""The losses of a training step on a GPU: a few kernels in Triton around one evaluation of the field.

Numbers and gradients are those of `renderer.py`, `volume_rendering.py`, `losses.py` and `direct_losses.py`, which take
a thousand operations for them. Nothing waits for the GPU, and everything that changes from step to step is read there.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
import triton
from jaxtyping import Float, Float64, Int16, Int32, Int64
from torch import Tensor
from torch.autograd.function import once_differentiable

from sl_nerfstudio.field.device_kernels import block, launch
from sl_nerfstudio.geometry.devices import Intrinsics
from sl_nerfstudio.rendering import triton_kernels as kernels
from sl_nerfstudio.rendering.losses import LossConfig
from sl_nerfstudio.rendering.renderer import CACHE_SAMPLES, HALF_WIDTH, SamplingConfig

_SUMS = 15  # see the kernels; the last one stays 0
_POINTS, _ELEMENTS = 256, 256  # of a program: points; samples on rays


@runtime_checkable
class MergedField(Protocol):
    """A field that evaluates values at all points and gradients at the last ones together."""

    def sdf_and_last_gradients(
        self, p: Float[Tensor, "n 3"], first: int
    ) -> tuple[Float[Tensor, "n"], Float[Tensor, "k 3"]]:
        """See `SDFField`."""
        ...


@dataclass(frozen=True)
class Pixels:
    """Pixels of a table of all pixels, on the device."""

    index: Int64[Tensor, "rays"]  # which of the rows `among` of the table, or of all rows, if that is empty
    among: Int32[Tensor, "m"]
    frame: Int32[Tensor, "n"]
    row: Int16[Tensor, "n"]
    column: Int16[Tensor, "n"]
    coords: Float[Tensor, "n 2"]  # pattern pixels; NaN where not decoded
    pattern: Float[Tensor, "n"]  # [0, 1], in half precision


@dataclass(frozen=True)
class Step:
    """All that a step needs besides the field and the poses. Scalars are on the device."""

    pixels: Pixels
    cameras: Intrinsics  # batch (frames)
    projector: Intrinsics  # batch ()
    pattern: Float[Tensor, "h w"]
    kappa: Float64[Tensor, ""]
    surface_width: Float64[Tensor, ""]
    noise_px: Float[Tensor, ""]
    px_per_length: Float[Tensor, ""]
    cache: Float[Tensor, "z y x"]  # the cached grid
    sampling: SamplingConfig
    losses: LossConfig
    renders: bool  # else only the terms on points

    @property
    def rendered(self) -> int:
        """Rays that are rendered."""
        return min(self.sampling.render_rays, len(self.pixels.index)) if self.renders else 0

    @property
    def direct(self) -> int:
        """Rays whose triangulated points count."""
        return len(self.pixels.index) if self.losses.direct else 0

    @property
    def without_gradients(self) -> int:
        """Points of which only values are needed: samples on rays, then those on either side of the surface."""
        return self.rendered * self.sampling.samples + 2 * self.direct


def step_losses(
    field: MergedField,
    step: Step,
    T_scene_camera: Float[Tensor, "frames 4 4"],
    T_scene_projector: Float[Tensor, "frames 4 4"],
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """The weighted losses by name, differentiable by the field's parameters; the rendered ones also by the poses.

    And, if rays are rendered, how well they fit: `coordinate_px`, the median distance of the coordinates in pattern
    pixels, and `pattern_cosine`.
    """
    T_scene_projector = T_scene_projector.contiguous()
    moves = T_scene_camera.requires_grad or T_scene_projector.requires_grad
    zeros = _Zeros(len(T_scene_camera) if moves else 0, T_scene_camera)
    origins, directions, points, *rest = _Points.apply(
        step, zeros, T_scene_camera.contiguous(), T_scene_projector.detach()
    )
    f, slopes = field.sdf_and_last_gradients(points, step.without_gradients)
    tensors = (f, slopes, origins, directions, T_scene_projector)
    coordinates, pattern, surface, free_space, eikonal, px, cosine = _Losses.apply(step, zeros, *tensors, *rest)
    terms: dict[str, Tensor] = {}
    if step.rendered:
        terms |= {"coordinates": coordinates, "pattern": pattern}
    if step.direct:
        terms |= {"surface": surface, "free_space": free_space}
    terms["eikonal"] = eikonal
    return terms, {"coordinate_px": px, "pattern_cosine": cosine} if step.rendered else {}


class _Zeros:
    """All that begins as 0 in a step, set by one launch: the sums, and the adjoints of the two devices' poses."""

    def __init__(self, frames: int, like: Tensor) -> None:
        whole = like.new_zeros(_SUMS + 2 * 16 * frames)
        self.sums = whole[:_SUMS]
        camera, projector = whole[_SUMS:].view(2, frames, 4, 4)
        self._adjoints = {"cameras": camera, "projectors": projector}

    def adjoint(self, devices: str, like: Tensor) -> Tensor:
        """Zeros for the poses `like`; a second backward pass gets new ones."""
        zeros = self._adjoints.pop(devices, None)
        return torch.zeros_like(like) if zeros is None else zeros


class _Points(torch.autograd.Function):
    """Rays, samples on them, and the points of the other terms; differentiable by the cameras' poses."""

    @staticmethod
    def forward(
        ctx: Any, step: Step, zeros: _Zeros, T_scene_camera: Tensor, T_scene_projector: Tensor
    ) -> tuple[Tensor, ...]:
        x = step.pixels
        rays, r, n = len(x.index), step.rendered, step.direct
        m, samples, resolution = step.sampling.eikonal_points, step.sampling.samples, len(step.cache)
        empty = T_scene_camera.new_empty
        origins, directions, measured = empty(rays, 3), empty(rays, 3), empty(rays, 2)
        views, captured = empty(rays, dtype=torch.int32), empty(rays)
        noise = torch.rand(r * samples + 3 * n + 3 * m, device=origins.device)
        t, points, weight, at_least = empty(r, samples), empty(step.without_gradients + n + m, 3), empty(n), empty(n)
        table = (x.index, x.among, x.frame, x.row, x.column, x.coords, x.pattern)
        poses = (T_scene_camera, step.cameras.params, T_scene_projector, step.projector.params)
        scalars = (step.kappa, step.noise_px, step.px_per_length)
        found = (views, origins, directions, measured, captured, t, points, weight, at_least)
        constants = {
            "STRIDES": tuple(column.stride(0) for column in table[2:]),
            "AMONG": len(x.among) > 0, "CAMERA_DOE": step.cameras.model == "DOE",
            "CAMERA_DISTORTED": step.cameras.distorted, "RENDERS": r > 0, "DIRECT": n > 0,
            "SURFACE": step.sampling.strategy == "surface", "HALF_WIDTH": HALF_WIDTH,
        }  # fmt: skip
        arrays = (*table, *poses, noise, step.cache, *scalars, *found, rays, r, m, resolution)
        _along_rays(step, kernels.begin_rays, max(rays, m), *arrays, **constants)
        ctx.step, ctx.zeros = step, zeros
        ctx.save_for_backward(T_scene_camera, views, directions, t)
        ctx.mark_non_differentiable(views, t, measured, captured, weight, at_least)
        return origins, directions, points, views, t, measured, captured, weight, at_least

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> Any:
        T, views, directions, t = ctx.saved_tensors
        d_origins, d_directions, d_points = (x.contiguous() for x in grad_outputs[:3])
        d_T, r = ctx.zeros.adjoint("cameras", T), ctx.step.rendered
        adjoints = (d_points, d_origins, d_directions, d_T)
        _along_rays(ctx.step, kernels.rays_adjoint, r, T, views, directions, t, *adjoints, r)
        return None, None, d_T, None


class _Losses(torch.autograd.Function):
    """The weighted losses and what rays see; differentiable by the field's values and slopes, rays and projectors."""

    @staticmethod
    def forward(ctx: Any, step: Step, zeros: _Zeros, *tensors: Tensor) -> tuple[Tensor, ...]:
        f, slopes, *_ = tensors
        r, sums, found, error = step.rendered, zeros.sums, f.new_empty(7), f.new_empty(step.rendered)
        if r:
            outputs = (error, sums, r, *step.pattern.shape)
            _along_rays(step, kernels.render, r, *_rendering(step, tensors), *outputs)
            error = error.sort().values
        size = block(_POINTS, len(slopes))
        arrays = (*_on_points(step, tensors), sums, *_counts(step))
        launch(kernels.direct, triton.cdiv(len(slopes), size), *arrays, BLOCK=size)
        constants = {**_coordinate_weights(step.losses), **_weights_of(step.losses), "PATTERN": step.losses.pattern}
        launch(kernels.losses, 1, sums, step.px_per_length, error, found, **constants, num_warps=1)
        ctx.step, ctx.zeros = step, zeros
        ctx.save_for_backward(*tensors, sums)
        outputs = found.unbind()
        ctx.mark_non_differentiable(*outputs[5:])
        ctx.set_materialize_grads(False)
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor | None) -> Any:
        step: Step = ctx.step
        *tensors, sums = ctx.saved_tensors
        f, slopes, origins, _, T, *_ = tensors
        r, w = step.rendered, step.losses
        g = [sums[-1] if x is None else x for x in grad_outputs[:5]]
        d_f, d_slopes = torch.empty_like(f), torch.empty_like(slopes)
        by_rays, by_pose = any(ctx.needs_input_grad[4:6]), ctx.needs_input_grad[6]
        d_rays = (f.new_empty if r == len(origins) else f.new_zeros)(2, len(origins) if by_rays else 0, 3)
        d_T = ctx.zeros.adjoint("projectors", T) if by_pose else f.new_empty(0, 4, 4)
        if r:
            adjoints = (sums, step.px_per_length, *g[:2], d_f, d_rays[0], d_rays[1], d_T)
            constants = {**_coordinate_weights(w), "PATTERN": w.pattern, "RAYS": by_rays, "POSES": by_pose}
            arrays = (*_rendering(step, tensors), *adjoints, r, *step.pattern.shape)
            _along_rays(step, kernels.render_adjoint, r, *arrays, **constants)
        size = block(_POINTS, len(slopes))
        arrays = (*_on_points(step, tensors), sums, *g[2:], d_f, d_slopes, *_counts(step))
        launch(kernels.direct_adjoint, triton.cdiv(len(slopes), size), *arrays, **_weights_of(w), BLOCK=size)
        rays = (d_rays[0], d_rays[1]) if by_rays else (None, None)
        return None, None, d_f, d_slopes, *rays, d_T if by_pose else None, *[None] * 6


def _along_rays(step: Step, kernel: Any, n: int, *arguments: Any, **constants: Any) -> None:
    """Launch a kernel for n rays, each with its samples."""
    columns = triton.next_power_of_2(step.sampling.samples)
    widest = max(columns, CACHE_SAMPLES if kernel is kernels.begin_rays else 1)
    size = block(max(_ELEMENTS // widest, 1), n)
    if kernel is not kernels.rays_adjoint:
        constants |= {"DOE": step.projector.model == "DOE", "DISTORTED": step.projector.distorted}
    shape = {"SAMPLES": step.sampling.samples, "COLUMNS": columns, "BLOCK": size}
    launch(kernel, triton.cdiv(n, size), *arguments, **constants, **shape)


def _rendering(step: Step, tensors: Sequence[Tensor]) -> tuple[Any, ...]:
    """What the kernels along rays read."""
    f, _, origins, directions, T, views, t, measured, captured, *_ = tensors
    projector = (step.projector.params, step.pattern)
    return f, t, origins, directions, T, views, *projector, step.kappa, measured, captured


def _on_points(step: Step, tensors: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """What the kernels on triangulated and random points read."""
    f, slopes, _, directions, _, _, _, measured, _, weight, at_least = tensors
    return f, slopes, directions, measured, weight, at_least, step.surface_width


def _counts(step: Step) -> tuple[int, int, int]:
    """The first point on a side of the surface, triangulated points, and others."""
    return step.rendered * step.sampling.samples, step.direct, step.sampling.eikonal_points


def _coordinate_weights(w: LossConfig) -> dict[str, float]:
    """Weight of the coordinates' error as a length, or, if that is 0, per pattern pixel."""
    if w.coordinates_per_pixel is None:
        return {"PER_LENGTH": w.coordinates, "PER_PIXEL": 0.0}
    return {"PER_LENGTH": 0.0, "PER_PIXEL": w.coordinates_per_pixel}


def _weights_of(w: LossConfig) -> dict[str, float]:
    """Weights of the terms on points."""
    return {"SURFACE": w.surface, "FREE_SPACE": w.free_space, "EIKONAL": w.eikonal}
