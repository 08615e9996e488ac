"""The interface of an implementation of the field, and what the compiled one supports.

An implementation evaluates the field inside and outside its box and pulls gradients back. It does not use autograd:
`autograd.py` makes torch operations from it.
"""

from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from sl_nerfstudio.field.hash_grid import GridLayout

BackendName = Literal["auto", "torch", "numba"]


@dataclass(frozen=True)
class FieldState:
    """Everything that a field's values depend on, apart from the points."""

    table: Float[Tensor, "rows f"]
    level_weights: Float[Tensor, "levels"]
    mlp: tuple[Tensor, ...]
    """Weight and bias of each layer, input to output."""


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


def numba_cannot(layout: GridLayout, table: Tensor) -> str | None:
    """Why the compiled kernels cannot serve a field, or None if they can."""
    if table.device.type != "cpu":
        return f"the numba backend runs on the CPU, the field is on {table.device}"
    if table.dtype != torch.float32:
        return f"the numba backend computes in float32, the field is {table.dtype}"
    if layout.features != 8:
        return f"the numba backend needs 8 features per level, the field has {layout.features}"
    return None
