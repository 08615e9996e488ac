"""The field as torch operations: values, and values with gradients, both differentiable once."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from sl_nerfstudio.field.backend import FieldBackend, FieldState, MergedBackend
from sl_nerfstudio.field.table_gradient import TableGradient, Wanted, wanted


@dataclass(frozen=True)
class _Target:
    """Where a backward pass stores the parameters' gradients."""

    parameters: bool
    """Whether any parameter's gradient is needed."""
    table: Tensor | None
    """What the table's gradient is added to."""
    marks: Tensor | None
    """Marks of the table's rows, if it is the persistent buffer."""
    returned: Tensor | None
    """The table's gradient, if the backward function returns it."""


def _target(ctx: Any) -> _Target:
    table, *mlp = ctx.parameters
    table_wanted = wanted(table)
    if table_wanted == Wanted.NO:
        return _Target(any(wanted(x) != Wanted.NO for x in mlp), None, None, None)
    buffer: TableGradient | None = ctx.buffer
    if table_wanted == Wanted.ACCUMULATED and buffer is not None:
        return _Target(True, buffer.attach(table), buffer.marks, None)
    fresh = torch.zeros_like(table)
    return _Target(True, fresh, None, fresh)


Active = tuple[int, ...]  # numbers of the levels that are switched on


def _keep(
    ctx: Any, backend: FieldBackend, buffer: TableGradient | None, active: Active, tensors: tuple[Tensor, ...]
) -> FieldState:
    p, places, level_weights, table, *mlp = tensors
    ctx.backend, ctx.buffer, ctx.parameters, ctx.active = backend, buffer, (table, *mlp), active
    ctx.save_for_backward(p, places, level_weights.clone(), table, *mlp)  # torch checks that none changes meanwhile
    return FieldState(table, level_weights, tuple(mlp), places, active)


def _kept(ctx: Any) -> tuple[Tensor, FieldState]:
    p, places, level_weights, table, *mlp = ctx.saved_tensors
    return p, FieldState(table, level_weights, tuple(mlp), places, ctx.active)


class _Value(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, backend: FieldBackend, buffer: TableGradient | None, active: Active, *tensors: Tensor
    ) -> Tensor:
        return backend.evaluate(_keep(ctx, backend, buffer, active, tensors), tensors[0], False)[0]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> Any:
        p, state = _kept(ctx)
        to = _target(ctx)
        result = ctx.backend.pull_back(
            state, p, grad_outputs[0], ctx.needs_input_grad[3], to.parameters, to.table, to.marks
        )
        return (None, None, None, result.points, None, None, to.returned, *(result.mlp or [None] * len(state.mlp)))


class _ValueAndGradient(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, backend: FieldBackend, buffer: TableGradient | None, active: Active, *tensors: Tensor
    ) -> tuple[Tensor, Tensor]:
        f, n = backend.evaluate(_keep(ctx, backend, buffer, active, tensors), tensors[0], True)
        assert n is not None
        return f, n

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> Any:
        p, state = _kept(ctx)
        to = _target(ctx)
        mlp: tuple[Tensor | None, ...] = (None,) * len(state.mlp)
        if to.parameters:
            mlp = ctx.backend.pull_back_gradient(state, p, *grad_outputs, to.table, to.marks)
        return (None, None, None, None, None, None, to.returned, *mlp)


class _Merged(torch.autograd.Function):
    """Values at points, and gradients at those from `first` on, by a backend that evaluates them together."""

    @staticmethod
    def forward(
        ctx: Any, backend: MergedBackend, buffer: TableGradient | None, active: Active, first: int, *tensors: Tensor
    ) -> tuple[Tensor, Tensor]:
        p, places, level_weights, table, *mlp = tensors
        ctx.backend, ctx.buffer, ctx.parameters, ctx.active = backend, buffer, (table, *mlp), active
        state = FieldState(table, level_weights, tuple(mlp), places, active)
        f, gradient, ctx.kept = backend.evaluate_all(state, p, first)
        ctx.save_for_backward(p, places, level_weights, table, *mlp)
        return f, gradient

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> Any:
        _, state = _kept(ctx)
        to = _target(ctx)
        g, v = (x.contiguous() for x in grad_outputs)
        result = ctx.backend.pull_back_all(
            state, ctx.kept, g, v, ctx.needs_input_grad[4], to.parameters, to.table, to.marks
        )
        mlp = result.mlp or [None] * len(state.mlp)
        return (None, None, None, None, result.points, None, None, to.returned, *mlp)


def value(
    backend: FieldBackend | MergedBackend,
    buffer: TableGradient | None,
    state: FieldState,
    p: Float[Tensor, "n 3"],
) -> Float[Tensor, "n"]:
    """Values at `p`, differentiable with respect to parameters and points.

    If there is a `buffer`, it is or becomes the table's `.grad`, and `backward()` adds to it.
    """
    if isinstance(backend, MergedBackend):
        return _apply_merged(backend, buffer, state, p, len(p))[0]
    return _apply(_Value, backend, buffer, state, p)


def value_and_gradient(
    backend: FieldBackend | MergedBackend,
    buffer: TableGradient | None,
    state: FieldState,
    p: Float[Tensor, "n 3"],
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"]]:
    """Values and gradients at `p`, both differentiable with respect to the parameters; `p` is a constant."""
    if isinstance(backend, MergedBackend):
        return _apply_merged(backend, buffer, state, p.detach(), 0)
    return _apply(_ValueAndGradient, backend, buffer, state, p.detach())


def value_and_last_gradients(
    backend: FieldBackend | MergedBackend,
    buffer: TableGradient | None,
    state: FieldState,
    p: Float[Tensor, "n 3"],
    first: int,
) -> tuple[Float[Tensor, "n"], Float[Tensor, "k 3"]]:
    """`value` at all points, and gradients at the k points from `first` on, which are constants.

    Together, if the backend can, which saves launches on a GPU.
    """
    if isinstance(backend, MergedBackend):
        return _apply_merged(backend, buffer, state, p, first)
    f, gradient = value_and_gradient(backend, buffer, state, p[first:])
    return torch.cat([value(backend, buffer, state, p[:first]), f]), gradient


def _apply_merged(
    backend: MergedBackend, buffer: TableGradient | None, state: FieldState, p: Tensor, first: int
) -> tuple[Tensor, Tensor]:
    p = p.to(state.table.dtype).contiguous()
    with torch.autocast(p.device.type, enabled=False):
        tensors = (p, state.places, state.level_weights, state.table, *state.mlp)
        return _Merged.apply(backend, buffer, state.active, first, *tensors)


def _apply(function: Any, backend: FieldBackend, buffer: TableGradient | None, state: FieldState, p: Tensor) -> Any:
    """Call an autograd function in the parameters' precision, even if mixed precision is switched on."""
    with torch.autocast(p.device.type, enabled=False):
        tensors = (p.to(state.table.dtype), state.places, state.level_weights, state.table, *state.mlp)
        return function.apply(backend, buffer, state.active, *tensors)
