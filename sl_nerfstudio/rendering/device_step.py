"""The losses of a training step on a GPU: a few kernels around one evaluation of the field.

Numbers and gradients are those of `renderer.py`, `volume_rendering.py`, `losses.py` and `direct_losses.py`, which take
a thousand operations for them. Nothing waits for the GPU, and everything that changes from step to step is read there.
"""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int16, Int32, Int64
from torch import Tensor
from torch.autograd.function import once_differentiable

from sl_nerfstudio.device_kernels import launch
from sl_nerfstudio.geometry.devices import Intrinsics
from sl_nerfstudio.geometry.devices.models import MODELS
from sl_nerfstudio.rendering.settings import LossConfig, SamplingConfig
from sl_nerfstudio.rendering.volume_rendering import Rendered
from sl_nerfstudio.rendering.warp_kernels import direct as direct_kernels
from sl_nerfstudio.rendering.warp_kernels import points as point_kernels
from sl_nerfstudio.rendering.warp_kernels import rays as ray_kernels

_SUMS = 13


@runtime_checkable
class MergedField(Protocol):
    """A field that evaluates values at some points and values with gradients at others together."""

    def sdf_and_gradients(
        self, p: Float[Tensor, "n 3"], q: Float[Tensor, "k 3"]
    ) -> tuple[Float[Tensor, "n"], Float[Tensor, "k"], Float[Tensor, "k 3"]]:
        """See `SDFField`."""
        ...


@dataclass(frozen=True)
class Pixels:
    """Pixels of a table of all pixels, on the device."""

    index: Int64[Tensor, "rays"]  # which of the table's
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

    kappa: Float[Tensor, ""]
    surface_width: Float[Tensor, ""]
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


@dataclass(frozen=True)
class StepLosses:
    """The weighted losses of a step by name; what rays saw and what was captured there, if rays were rendered."""

    terms: dict[str, Tensor]
    rendered: Rendered | None
    coordinates: Float[Tensor, "rays 2"]
    pattern: Float[Tensor, "rays"]


def step_losses(
    field: MergedField,
    step: Step,
    T_scene_camera: Float[Tensor, "frames 4 4"],
    T_scene_projector: Float[Tensor, "frames 4 4"],
) -> StepLosses:
    """The losses, differentiable by the field's parameters and, of the rendered ones only, by the poses."""
    T_scene_projector = T_scene_projector.contiguous()
    origins, directions, values, others, *rest = _Points.apply(
        step, T_scene_camera.contiguous(), T_scene_projector.detach()
    )
    f, f_others, slopes = field.sdf_and_gradients(values, others)
    tensors = (f, f_others, slopes, origins, directions, T_scene_projector)
    coordinates, pattern, surface, free_space, eikonal, *seen = _Losses.apply(step, *tensors, *rest)
    terms: dict[str, Tensor] = {}
    if step.rendered:
        terms |= {"coordinates": coordinates, "pattern": pattern}
    if step.direct:
        terms |= {"surface": surface, "free_space": free_space}
    measured, captured = rest[2:4]
    n = step.rendered
    rendered = Rendered(*seen) if n else None
    return StepLosses(terms | {"eikonal": eikonal}, rendered, measured[:n], captured[:n])


def _model(intrinsics: Intrinsics) -> tuple[int, int]:
    return MODELS[intrinsics.model].code, int(intrinsics.distorted)


class _Points(torch.autograd.Function):
    """Rays, samples on them, and the points of the other terms; differentiable by the cameras' poses."""

    @staticmethod
    def forward(ctx: Any, step: Step, T_scene_camera: Tensor, T_scene_projector: Tensor) -> tuple[Tensor, ...]:
        x, devices, current = step.pixels, step.devices, step.current
        rays, r, n = len(x.index), step.rendered, step.direct
        m, samples = step.sampling.eikonal_points, step.sampling.samples
        empty = T_scene_camera.new_empty
        origins, directions, measured = empty(rays, 3), empty(rays, 3), empty(rays, 2)
        views, captured = empty(rays, dtype=torch.int32), empty(rays)
        table = (x.index, x.frame, x.row, x.column, x.coords, x.pattern)
        cameras = (devices.cameras.params, *_model(devices.cameras))
        found = (views, origins, directions, measured, captured)
        launch(point_kernels.pixel_rays, rays, *table, T_scene_camera, *cameras, *found)
        noise = torch.rand(r * samples + 3 * n + 3 * m, device=origins.device)
        t, values, others = empty(r, samples), empty(r * samples + 2 * n, 3), empty(n + m, 3)
        weight, at_least = empty(n), empty(n)
        if r:
            surface = (int(step.sampling.strategy == "surface"), 2 / (len(step.cache) - 1), step.sampling.half_width)
            where = (step.cache, *surface, current.kappa.reshape(1))
            launch(point_kernels.sample, r, origins, directions, noise, *where, t, values)
        if n:
            projector = (devices.projector.params, *_model(devices.projector))
            scale = (current.noise_px.reshape(1), current.px_per_length.reshape(1))
            given = (origins, directions, views, T_scene_projector, measured, *projector, *scale)
            made = (others, values[r * samples :], weight, at_least)
            launch(point_kernels.triangulate, n, *given, noise[r * samples :], *made)
        launch(point_kernels.random_points, m, noise[r * samples + 3 * n :], others[n:])
        ctx.rendered = r
        ctx.save_for_backward(T_scene_camera, views, directions, t)
        ctx.mark_non_differentiable(others, views, t, measured, captured, weight, at_least)
        return origins, directions, values, others, views, t, measured, captured, weight, at_least

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> Any:
        T, views, directions, t = ctx.saved_tensors
        d_origins, d_directions, d_values = (x.contiguous() for x in grad_outputs[:3])
        d_T = torch.zeros_like(T)
        adjoints = (d_values, d_origins, d_directions, d_T)
        launch(point_kernels.rays_adjoint, ctx.rendered, T, views, directions, t, *adjoints)
        return None, d_T, None


class _Losses(torch.autograd.Function):
    """The weighted losses and what rays see; differentiable by the field's values and slopes, rays and projectors."""

    @staticmethod
    def forward(ctx: Any, step: Step, *tensors: Tensor) -> tuple[Tensor, ...]:
        f, f_others, slopes, _, directions, _, _, t, measured, _, weight, at_least = tensors
        r, current, w = step.rendered, step.current, step.losses
        sums, found = f.new_zeros(_SUMS), f.new_empty(5)
        before, coordinates = torch.empty_like(t), f.new_empty(r, 2)
        accumulation, depth, rendered, lit, lit_weight = f.new_empty(5, r).unbind()
        if r:
            outputs = (before, accumulation, depth, coordinates, rendered, lit, lit_weight)
            launch(ray_kernels.render, r, *_rendering(step, tensors), *outputs, sums)
        points = (f_others, slopes, f[t.numel() :], directions, measured, weight, at_least)
        launch(direct_kernels.direct, len(f_others), *points, current.surface_width.reshape(1), sums)
        scale = (current.px_per_length.reshape(1), *_coordinate_weights(w))
        launch(direct_kernels.losses, 1, sums, *scale, w.pattern, w.surface, w.free_space, w.eikonal, found)
        ctx.step = step
        ctx.save_for_backward(*tensors, before, coordinates, rendered, lit, lit_weight, sums)
        seen = (accumulation, depth, coordinates, rendered, lit)
        ctx.mark_non_differentiable(*seen)
        ctx.set_materialize_grads(False)
        return *found.unbind(), *seen

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor | None) -> Any:
        step: Step = ctx.step
        tensors, kept = ctx.saved_tensors[:12], ctx.saved_tensors[12:]
        f, f_others, slopes, origins, directions, T, _, t, measured, _, weight, at_least = tensors
        r, current, w, sums = step.rendered, step.current, step.losses, kept[-1]
        g = _scalars(grad_outputs[:5], f)
        d_f, d_others, d_slopes = torch.empty_like(f), torch.empty_like(f_others), torch.empty_like(slopes)
        by_rays, by_pose = any(ctx.needs_input_grad[4:6]), ctx.needs_input_grad[6]
        d_rays = (f.new_empty if r == len(origins) else f.new_zeros)(2, len(origins) if by_rays else 0, 3)
        d_T = torch.zeros_like(T) if by_pose else f.new_empty(0, 4, 4)
        if r:
            scale = (current.px_per_length.reshape(1), *_coordinate_weights(w), w.pattern)
            adjoints = (d_f[: t.numel()].view(t.shape), d_rays[0], d_rays[1], d_T)
            launch(ray_kernels.render_adjoint, r, *_rendering(step, tensors), *kept, *scale, *g[:2], *adjoints)
        points = (f_others, slopes, f[t.numel() :], directions, measured, weight, at_least)
        scale = (current.surface_width.reshape(1), sums, w.surface, w.free_space, w.eikonal)
        launch(
            direct_kernels.direct_adjoint, len(f_others), *points, *scale, *g[2:], d_others, d_slopes, d_f[t.numel() :]
        )
        rays = (d_rays[0], d_rays[1]) if by_rays else (None, None)
        return None, d_f, d_others, d_slopes, *rays, d_T if by_pose else None, *[None] * 6


def _rendering(step: Step, tensors: tuple[Tensor, ...]) -> tuple[Any, ...]:
    """What the kernels along rays read."""
    f, _, _, origins, directions, T, views, t, measured, captured, *_ = tensors
    projector = (step.devices.projector.params, *_model(step.devices.projector), step.devices.pattern)
    sdf = f[: t.numel()].view(t.shape)
    return sdf, t, origins, directions, T, views, *projector, step.current.kappa.reshape(1), measured, captured


def _coordinate_weights(w: LossConfig) -> tuple[float, float]:
    """Weight of the coordinates' error as a length, or, if that is 0, per pattern pixel."""
    return (w.coordinates, 0.0) if w.coordinates_per_pixel is None else (0.0, w.coordinates_per_pixel)


def _scalars(gradients: tuple[Tensor | None, ...], like: Tensor) -> list[Tensor]:
    """Gradients of losses as arrays of one number, 0 for losses that are not used."""
    zero = like.new_zeros(1) if any(g is None for g in gradients) else like
    return [zero if g is None else g.reshape(1) for g in gradients]
