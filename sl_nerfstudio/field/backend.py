"""The interface of an implementation of the field, and what the compiled one supports.

An implementation evaluates the field inside and outside its box and pulls gradients back. It does not use autograd:
`autograd.py` makes torch operations from it.
"""

from dataclasses import dataclass
from importlib.util import find_spec
from typing import Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int32, UInt8
from torch import Tensor

from sl_nerfstudio.field.hash_grid import GridLayout

BackendName = Literal["auto", "torch", "numba", "warp"]


@dataclass(frozen=True)
class FieldState:
    """Everything that a field's values depend on, apart from the points."""

    table: Float[Tensor, "rows f"]
    level_weights: Float[Tensor, "levels"]
    mlp: tuple[Tensor, ...]
    """Weight and bias of each layer, input to output."""
    places: Int32[Tensor, "levels 3"]
    """Where the levels are in the table, see `HashGrid`."""
    active: tuple[int, ...]
    """Levels whose weight is not 0; known to the host, which need not wait for a GPU."""


@dataclass(frozen=True)
class Pulled:
    """The result of a pull-back; None for parts that were not requested."""

    points: Float[Tensor, "n 3"] | None
    mlp: tuple[Tensor, ...] | None


@runtime_checkable
class FieldBackend(Protocol):
    """An implementation of the field for one layout and activation."""

    def evaluate(
        self, state: FieldState, p: Float[Tensor, "n 3"], gradient: bool
    ) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"] | None]:
        """Values at points, and their gradients on request."""
        ...

    def pull_back(
        self,
        state: FieldState,
        p: Float[Tensor, "n 3"],
        g: Float[Tensor, "n"],
        points: bool,
        parameters: bool,
        table_gradient: Float[Tensor, "rows f"] | None,
        marks: UInt8[Tensor, "marks"] | None,
    ) -> Pulled:
        """Gradients of `sum g f(p)` with respect to the points and to the parameters, on request.

        The table's gradient is added to `table_gradient`, and the rows written to are marked in `marks`.
        """
        ...

    def pull_back_gradient(
        self,
        state: FieldState,
        p: Float[Tensor, "n 3"],
        g: Float[Tensor, "n"],
        v: Float[Tensor, "n 3"],
        table_gradient: Float[Tensor, "rows f"] | None,
        marks: UInt8[Tensor, "marks"] | None,
    ) -> tuple[Tensor, ...]:
        """MLP gradients of `sum g f(p) + v . grad f(p)`; the table's as in `pull_back`."""
        ...


@dataclass(frozen=True)
class Kept:
    """What a `MergedBackend` keeps between an evaluation and its pull-back."""


@runtime_checkable
class MergedBackend(Protocol):
    """An implementation that evaluates all points together: values of all, gradients of those from `first` on.

    Below, n is the number of points and k = n - first.
    """

    def evaluate_all(
        self, state: FieldState, p: Float[Tensor, "n 3"], first: int
    ) -> tuple[Float[Tensor, "n"], Float[Tensor, "k 3"], Kept]:
        """Values, gradients of the points from `first` on, and what the pull-back needs."""
        ...

    def pull_back_all(
        self,
        state: FieldState,
        kept: Kept,
        g: Float[Tensor, "n"],
        v: Float[Tensor, "k 3"],
        points: bool,
        parameters: bool,
        table_gradient: Float[Tensor, "rows f"] | None,
        marks: UInt8[Tensor, "marks"] | None,
    ) -> Pulled:
        """Gradients of `sum g f + v . grad f`, on request: by the points before `first`, and by the parameters.

        Those of the other points are 0; the table's as in `FieldBackend`.
        """
        ...


def numba_cannot(layout: GridLayout, table: Tensor) -> str | None:
    """Why the compiled kernels cannot serve a field, or None if they can."""
    if table.device.type != "cpu":
        return f"the numba backend runs on the CPU, the field is on {table.device}"
    if table.dtype != torch.float32:
        return f"the numba backend computes in float32, the field is {table.dtype}"
    if layout.features != 8:
        return f"the numba backend needs 8 features per level, the field has {layout.features}"
    return None


def warp_cannot(layout: GridLayout, table: Tensor) -> str | None:
    """Why the kernels for GPUs cannot serve a field, or None if they can; only imports Warp if all else fits."""
    if table.dtype != torch.float32:
        return f"the warp backend computes in float32, the field is {table.dtype}"
    if layout.features != 8:
        return f"the warp backend needs 8 features per level, the field has {layout.features}"
    if table.device.type not in ("cpu", "cuda"):
        return f"the warp backend runs on CUDA and on the CPU, the field is on {table.device}"
    if find_spec("warp") is None:
        return "the warp backend needs the package warp-lang: pip install 'sl-nerfstudio[cuda]'"
    from sl_nerfstudio.device_kernels import obstacle

    return obstacle(table.device)
