"""The losses of a training step on a GPU: a few kernels around one evaluation of the field.

Numbers and gradients are those of `renderer.py`, `volume_rendering.py`, `losses.py` and `direct_losses.py`, which take
a thousand operations for them. Nothing waits for the GPU, and everything that changes from step to step is read there.
"""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Float64, Int16, Int32, Int64
from torch import Tensor
from torch.autograd.function import once_differentiable

from sl_nerfstudio.field.device_kernels import launch
from sl_nerfstudio.geometry.devices import MODELS, Intrinsics
from sl_nerfstudio.rendering import warp_kernels as direct_kernels
from sl_nerfstudio.rendering import warp_kernels as point_kernels
from sl_nerfstudio.rendering import warp_kernels as ray_kernels
from sl_nerfstudio.rendering.losses import LossConfig
from sl_nerfstudio.rendering.renderer import HALF_WIDTH, SamplingConfig

_SUMS = 14  # see the kernels; the last one stays 0


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
class Devices:
    """Cameras and projector."""

    cameras: Intrinsics  # batch (frames)
    projector: Intrinsics  # batch ()
    pattern: Float[Tensor, "h w"]


@dataclass(frozen=True)
class Current:
    """What changes from step to step, as scalars on the device, and what the decoding is worth."""

    kappa: Float64[Tensor, ""]
    surface_width: Float64[Tensor, ""]
    noise_px: Float[Tensor, ""]
    px_per_length: Float[Tensor, ""]


@dataclass(frozen=True)
class Step:
    """All that a step needs besides the field and the poses."""

    pixels: Pixels
    devices: Devices
    current: Current
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


@dataclass(frozen=True)
class StepLosses:
    """The weighted losses of a step by name and, without gradients, how well rays fit what was captured."""

    terms: dict[str, Tensor]
    coordinate_px: Float[Tensor, ""] | None  # median distance of the coordinates, pattern pixels
    pattern_cosine: Float[Tensor, ""] | None


def step_losses(
    field: MergedField,
    step: Step,
    T_scene_camera: Float[Tensor, "frames 4 4"],
    T_scene_projector: Float[Tensor, "frames 4 4"],
) -> StepLosses:
    """The losses, differentiable by the field's parameters and, of the rendered ones only, by the poses."""
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
    return StepLosses(terms, px, cosine) if step.rendered else StepLosses(terms, None, None)


def _model(intrinsics: Intrinsics) -> tuple[int, int]:
    return MODELS[intrinsics.model].code, int(intrinsics.distorted)


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
        x, devices, current = step.pixels, step.devices, step.current
        rays, r, n = len(x.index), step.rendered, step.direct
        m, samples = step.sampling.eikonal_points, step.sampling.samples
        empty = T_scene_camera.new_empty
        origins, directions, measured = empty(rays, 3), empty(rays, 3), empty(rays, 2)
        views, captured = empty(rays, dtype=torch.int32), empty(rays)
        table = (x.index, x.among, x.frame, x.row, x.column, x.coords, x.pattern)
        cameras = (devices.cameras.params, *_model(devices.cameras))
        noise = torch.rand(r * samples + 3 * n + 3 * m, device=origins.device)
        t, points = empty(r, samples), empty(step.without_gradients + n + m, 3)
        others = points[step.without_gradients :]  # triangulated points, then random ones
        found = (views, origins, directions, measured, captured, noise[r * samples + 3 * n :], others[n:])
        launch(point_kernels.rays_and_random_points, max(rays, m), *table, T_scene_camera, *cameras, *found)
        weight, at_least = empty(n), empty(n)
        if r:
            surface = (int(step.sampling.strategy == "surface"), 2 / (len(step.cache) - 1), HALF_WIDTH)
            where = (step.cache, *surface, current.kappa.reshape(1))
            launch(point_kernels.sample, r, origins, directions, noise, *where, t, points)
        if n:
            projector = (devices.projector.params, *_model(devices.projector))
            scale = (current.noise_px.reshape(1), current.px_per_length.reshape(1))
            given = (origins, directions, views, T_scene_projector, measured, *projector, *scale)
            made = (others, points[r * samples :], weight, at_least)
            launch(point_kernels.triangulate, n, *given, noise[r * samples :], *made)
        ctx.rendered, ctx.zeros = r, zeros
        ctx.save_for_backward(T_scene_camera, views, directions, t)
        ctx.mark_non_differentiable(views, t, measured, captured, weight, at_least)
        return origins, directions, points, views, t, measured, captured, weight, at_least

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> Any:
        T, views, directions, t = ctx.saved_tensors
        d_origins, d_directions, d_points = (x.contiguous() for x in grad_outputs[:3])
        d_T = ctx.zeros.adjoint("cameras", T)
        adjoints = (d_points, d_origins, d_directions, d_T)
        launch(point_kernels.rays_adjoint, ctx.rendered, T, views, directions, t, *adjoints)
        return None, None, d_T, None


class _Losses(torch.autograd.Function):
    """The weighted losses and what rays see; differentiable by the field's values and slopes, rays and projectors."""

    @staticmethod
    def forward(ctx: Any, step: Step, zeros: _Zeros, *tensors: Tensor) -> tuple[Tensor, ...]:
        f, slopes, _, _, _, _, t, *_ = tensors
        r, current, w = step.rendered, step.current, step.losses
        sums, found = zeros.sums, f.new_empty(7)
        before, coordinates = torch.empty_like(t), f.new_empty(r, 2)
        rendered, lit, lit_weight, error = f.new_empty(4, r).unbind()
        if r:
            outputs = (before, coordinates, rendered, lit, lit_weight, error)
            launch(ray_kernels.render, r, *_rendering(step, tensors), *outputs, sums)
            error = error.sort().values
        launch(direct_kernels.direct, len(slopes), *_on_points(step, tensors), current.surface_width.reshape(1), sums)
        scale = (current.px_per_length.reshape(1), *_coordinate_weights(w))
        launch(direct_kernels.losses, 1, sums, *scale, w.pattern, w.surface, w.free_space, w.eikonal, error, found)
        ctx.step, ctx.zeros = step, zeros
        ctx.save_for_backward(*tensors, before, coordinates, rendered, lit, lit_weight, sums)
        outputs = found.unbind()
        ctx.mark_non_differentiable(*outputs[5:])
        ctx.set_materialize_grads(False)
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor | None) -> Any:
        step: Step = ctx.step
        tensors, kept = ctx.saved_tensors[:11], ctx.saved_tensors[11:]
        f, slopes, origins, _, T, _, t, *_ = tensors
        r, current, w, sums = step.rendered, step.current, step.losses, kept[-1]
        g = [sums[-1:] if x is None else x.reshape(1) for x in grad_outputs[:5]]
        d_f, d_slopes = torch.empty_like(f), torch.empty_like(slopes)
        by_rays, by_pose = any(ctx.needs_input_grad[4:6]), ctx.needs_input_grad[6]
        d_rays = (f.new_empty if r == len(origins) else f.new_zeros)(2, len(origins) if by_rays else 0, 3)
        d_T = ctx.zeros.adjoint("projectors", T) if by_pose else f.new_empty(0, 4, 4)
        if r:
            scale = (current.px_per_length.reshape(1), *_coordinate_weights(w), w.pattern)
            adjoints = (d_f[: t.numel()].view(t.shape), d_rays[0], d_rays[1], d_T)
            launch(ray_kernels.render_adjoint, r, *_rendering(step, tensors), *kept, *scale, *g[:2], *adjoints)
        scale = (current.surface_width.reshape(1), sums, w.surface, w.free_space, w.eikonal)
        adjoints = (d_f[step.without_gradients :], d_slopes, d_f[t.numel() :])
        launch(direct_kernels.direct_adjoint, len(slopes), *_on_points(step, tensors), *scale, *g[2:], *adjoints)
        rays = (d_rays[0], d_rays[1]) if by_rays else (None, None)
        return None, None, d_f, d_slopes, *rays, d_T if by_pose else None, *[None] * 6


def _rendering(step: Step, tensors: tuple[Tensor, ...]) -> tuple[Any, ...]:
    """What the kernels along rays read."""
    f, _, origins, directions, T, views, t, measured, captured, *_ = tensors
    projector = (step.devices.projector.params, *_model(step.devices.projector), step.devices.pattern)
    sdf = f[: t.numel()].view(t.shape)
    return sdf, t, origins, directions, T, views, *projector, step.current.kappa.reshape(1), measured, captured


def _on_points(step: Step, tensors: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """What the kernels on triangulated and random points read."""
    f, slopes, _, directions, _, _, t, measured, _, weight, at_least = tensors
    return f[step.without_gradients :], slopes, f[t.numel() :], directions, measured, weight, at_least


def _coordinate_weights(w: LossConfig) -> tuple[float, float]:
    """Weight of the coordinates' error as a length, or, if that is 0, per pattern pixel."""
    return (w.coordinates, 0.0) if w.coordinates_per_pixel is None else (0.0, w.coordinates_per_pixel)
