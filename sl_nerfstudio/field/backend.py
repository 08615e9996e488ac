"""The interface of an implementation of the field, and what the compiled one supports.

An implementation evaluates the field inside and outside its box and pulls gradients back. It does not use autograd: the
function at the end makes a torch operation from it.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import Enum, auto
from functools import partial
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int32, UInt8
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.autograd.graph import get_gradient_edge

from sl_nerfstudio.field.device_kernels import obstacle
from sl_nerfstudio.field.numba_grid import LIST, clear
from sl_nerfstudio.parallel import parallel, split

# The table's gradient: one buffer for the whole run, with marks on the rows that may not be zero.


class Wanted(Enum):
    """What a running backward pass needs from a parameter's gradient."""

    NO = auto()
    """Nothing: it is frozen, or `torch.autograd.grad` was called for other tensors only."""
    ACCUMULATED = auto()
    """It is added to `.grad`, by `backward()`."""
    RETURNED = auto()
    """The tensor itself is returned, by `torch.autograd.grad`."""


def wanted(parameter: Tensor) -> Wanted:
    """What the running backward pass needs from a leaf's gradient."""
    if not parameter.requires_grad:
        return Wanted.NO
    ask = getattr(torch._C, "_will_engine_execute_node", None)
    if ask is None:  # not a public function; without it only backward() is supported
        return Wanted.ACCUMULATED
    try:
        return Wanted.ACCUMULATED if ask(get_gradient_edge(parameter).node) else Wanted.NO
    except RuntimeError:  # raised if torch.autograd.grad was called for this very leaf
        return Wanted.RETURNED


class TableGradient:
    """Gradient buffer of a table, reused from step to step (a new one of 44 MB costs 20 ms in page faults).

    Rows that are not zero are marked, so that clearing and the optimiser need not read the others; on a GPU there are
    no marks, because reading all rows costs less. Kernels do not increase torch's version counter. If the counter has
    changed, something else wrote to the buffer, and every row counts as marked.
    """

    def __init__(self, table: Tensor):
        self.buffer = torch.zeros_like(table, memory_format=torch.contiguous_format)
        marks = -(-len(table) // 8) * 8 if table.device.type == "cpu" else 0
        self.marks = torch.zeros(marks, dtype=torch.uint8, device=table.device)
        self._version = self.buffer._version
        self._is_zero = True

    @staticmethod
    def known(table: Tensor) -> "TableGradient | None":
        """The buffer of a table, if there is one."""
        known = getattr(table, "_sl_gradient", None)
        return known if isinstance(known, TableGradient) and known._fits(table) else None

    @staticmethod
    def of(table: nn.Parameter) -> "TableGradient":
        """The buffer of a table, created at first use; the optimiser finds it here, too."""
        known = TableGradient.known(table)
        if known is None:
            known = table._sl_gradient = TableGradient(table)  # pyright: ignore
        return known

    def attach(self, table: nn.Parameter) -> Tensor:
        """The tensor to add the table's gradient to: `table.grad`, set to the (cleared) buffer if it is None."""
        if table.grad is None:
            self.clear()
            table.grad = self.buffer
        elif not self.holds(table.grad):
            return table.grad
        self.trusted_marks()
        self._is_zero = False
        return self.buffer

    def note_zero(self) -> None:
        """To be called by an optimiser that has set the whole buffer to zero."""
        self._is_zero, self._version = True, self.buffer._version

    def _fits(self, table: Tensor) -> bool:
        return self.buffer.shape == table.shape and self.buffer.device == table.device

    def holds(self, gradient: Tensor | None) -> bool:
        """Whether a gradient is this buffer."""
        return gradient is not None and gradient.data_ptr() == self.buffer.data_ptr()

    def trusted_marks(self) -> Tensor:
        """Marks of the rows that may not be zero: all of them, if torch wrote to the buffer."""
        if self.buffer._version != self._version:
            self.marks.fill_(1)
            self._version = self.buffer._version
        return self.marks

    def clear(self) -> None:
        """Set the buffer to zero."""
        if self.buffer.device.type != "cpu":
            if not self._is_zero or self.buffer._version != self._version:
                self.buffer.zero_()
                self.note_zero()
            return
        marks, gradient = self.trusted_marks().numpy(), self.buffer.numpy().reshape(-1)

        def work(start: int, stop: int) -> None:
            clear(gradient, marks, start, stop, np.empty(LIST, np.int64))

        parallel([partial(work, start, stop) for start, stop in split(len(self.buffer), 8, 64)])


BackendName = Literal["auto", "torch", "numba", "triton"]


@dataclass(frozen=True)
class FieldState:
    """Everything that a field's values depend on, apart from the points."""

    table: Float[Tensor, "rows f"]
    level_weights: Float[Tensor, "levels"]
    mlp: tuple[Tensor, ...]  # weight and bias of each layer, input to output
    places: Int32[Tensor, "levels 3"]  # where the levels are in the table, see `HashGrid`
    active: tuple[int, ...]  # levels whose weight is not 0; known to the host, which need not wait for a GPU


@dataclass(frozen=True)
class Target:
    """Which gradients of parameters a pull-back makes, and where it adds that of the table."""

    parameters: bool  # whether any parameter's gradient is needed
    table: Float[Tensor, "rows f"] | None  # what the table's gradient is added to
    marks: UInt8[Tensor, "marks"] | None  # marks of the table's rows, if it is the persistent buffer
    returned: Float[Tensor, "rows f"] | None  # the table's gradient, if the backward function returns it


@dataclass(frozen=True)
class Pulled:
    """The result of a pull-back; None for parts that were not requested."""

    points: Float[Tensor, "n 3"] | None
    mlp: tuple[Tensor, ...] | None


@runtime_checkable
class FieldBackend(Protocol):
    """An implementation of the field for one layout and activation: values of all points, gradients of the last ones.

    Below, n is the number of points, and k = n - first that of those from `first` on.
    """

    def evaluate_all(
        self, state: FieldState, p: Float[Tensor, "n 3"], first: int
    ) -> tuple[Float[Tensor, "n"], Float[Tensor, "k 3"], Any]:
        """Values, gradients of the points from `first` on, and what the pull-back needs."""
        ...

    def pull_back_all(
        self, state: FieldState, kept: Any, g: Float[Tensor, "n"], v: Float[Tensor, "k 3"], points: bool, to: Target
    ) -> Pulled:
        """Gradients of `sum g f + v . grad f`, on request: by the points before `first`, and by the parameters.

        Those of the other points are 0. The table's gradient is added to `to.table`, and the rows written to are marked
        in `to.marks`.
        """
        ...


class SeparateBackend(ABC):
    """A `FieldBackend` that evaluates points without gradients apart from those with."""

    @abstractmethod
    def evaluate(
        self, state: FieldState, p: Float[Tensor, "n 3"], gradient: bool
    ) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"] | None]:
        """Values at points, and their gradients on request."""

    @abstractmethod
    def pull_back(
        self, state: FieldState, p: Float[Tensor, "n 3"], g: Float[Tensor, "n"], points: bool, to: Target
    ) -> Pulled:
        """Gradients of `sum g f(p)` with respect to the points and to the parameters, on request."""

    @abstractmethod
    def pull_back_gradient(
        self, state: FieldState, p: Float[Tensor, "n 3"], g: Float[Tensor, "n"], v: Float[Tensor, "n 3"], to: Target
    ) -> tuple[Tensor, ...]:
        """MLP gradients of `sum g f(p) + v . grad f(p)`; the table's as in `FieldBackend`."""

    def evaluate_all(
        self, state: FieldState, p: Float[Tensor, "n 3"], first: int
    ) -> tuple[Float[Tensor, "n"], Float[Tensor, "k 3"], Float[Tensor, "n 3"]]:
        """See `FieldBackend`."""
        values = [self.evaluate(state, p[:first], False)[0]] if first else []
        gradient = p.new_empty(0, 3)
        if not first or first < len(p):
            f, found = self.evaluate(state, p[first:], True)
            values.append(f)
            gradient = gradient if found is None else found
        return values[0] if len(values) == 1 else torch.cat(values), gradient, p.detach()

    def pull_back_all(
        self,
        state: FieldState,
        kept: Float[Tensor, "n 3"],
        g: Float[Tensor, "n"],
        v: Float[Tensor, "k 3"],
        points: bool,
        to: Target,
    ) -> Pulled:
        """See `FieldBackend`."""
        first = len(kept) - len(v)
        before = Pulled(kept[:0] if points else None, None)
        if first:
            before = self.pull_back(state, kept[:first], g[:first], points, to)
        by_points = None if before.points is None else torch.cat([before.points, torch.zeros_like(v)])
        if not to.parameters or (first and not len(v)):
            return Pulled(by_points, before.mlp)
        by_mlp = self.pull_back_gradient(state, kept[first:], g[first:], v, to)
        if before.mlp is not None:
            by_mlp = tuple(a + b for a, b in zip(before.mlp, by_mlp, strict=True))
        return Pulled(by_points, by_mlp)


def numba_cannot(table: Tensor) -> str | None:
    """Why the compiled kernels cannot serve a field, or None if they can."""
    if table.device.type != "cpu":
        return f"the numba backend runs on the CPU, the field is on {table.device}"
    if table.dtype != torch.float32:
        return f"the numba backend computes in float32, the field is {table.dtype}"
    return None


def triton_cannot(table: Tensor) -> str | None:
    """Why the kernels for GPUs cannot serve a field, or None if they can."""
    if table.dtype != torch.float32:
        return f"the triton backend computes in float32, the field is {table.dtype}"
    if table.device.type not in ("cpu", "cuda"):
        return f"the triton backend runs on CUDA, the field is on {table.device}"
    return obstacle(table.device)


# The field as a torch operation, differentiable once.


def _target(ctx: Any) -> Target:
    table, *mlp = ctx.parameters
    table_wanted = wanted(table)
    if table_wanted == Wanted.NO:
        return Target(any(wanted(x) != Wanted.NO for x in mlp), None, None, None)
    buffer: TableGradient | None = ctx.buffer
    if table_wanted == Wanted.ACCUMULATED and buffer is not None:
        return Target(True, buffer.attach(table), buffer.marks, None)
    fresh = torch.zeros_like(table)
    return Target(True, fresh, None, fresh)


class _Evaluated(torch.autograd.Function):
    """Values at points, and gradients at those from `first` on."""

    @staticmethod
    def forward(
        ctx: Any,
        backend: FieldBackend,
        buffer: TableGradient | None,
        active: tuple[int, ...],
        first: int,
        *tensors: Tensor,
    ) -> tuple[Tensor, Tensor]:
        p, places, level_weights, table, *mlp = tensors
        ctx.backend, ctx.buffer, ctx.parameters, ctx.active = backend, buffer, (table, *mlp), active
        state = FieldState(table, level_weights, tuple(mlp), places, active)
        f, gradient, ctx.kept = backend.evaluate_all(state, p, first)
        ctx.save_for_backward(*tensors)  # torch checks that none changes meanwhile
        return f, gradient

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> Any:
        _, places, level_weights, table, *mlp = ctx.saved_tensors
        to = _target(ctx)
        g, v = (x.contiguous() for x in grad_outputs)
        state = FieldState(table, level_weights, tuple(mlp), places, ctx.active)
        result = ctx.backend.pull_back_all(state, ctx.kept, g, v, ctx.needs_input_grad[4], to)
        return (None, None, None, None, result.points, None, None, to.returned, *(result.mlp or [None] * len(mlp)))


def evaluated(
    backend: FieldBackend, buffer: TableGradient | None, state: FieldState, p: Float[Tensor, "n 3"], first: int
) -> tuple[Float[Tensor, "n"], Float[Tensor, "k 3"]]:
    """Values at all points, and gradients at the k points from `first` on, which are constants.

    Differentiable by the parameters, in their precision, even if mixed precision is switched on; the values also by the
    points before `first`. If there is a `buffer`, it is or becomes the table's `.grad`, and `backward()` adds to it.
    """
    with torch.autocast(p.device.type, enabled=False):
        p = p.to(state.table.dtype).contiguous()
        tensors = (p, state.places, state.level_weights, state.table, *state.mlp)
        return _Evaluated.apply(backend, buffer, state.active, first, *tensors)
