"""The table's gradient: one buffer for the whole run, with marks on the rows that hold something."""

from enum import Enum, auto
from functools import partial

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.graph import get_gradient_edge

from sl_nerfstudio.field.kernels.rows import LIST, clear
from sl_nerfstudio.threads import parallel, split


class Wanted(Enum):
    """What a running backward pass wants with a parameter's gradient."""

    NO = auto()
    """Nothing: it is frozen, or `torch.autograd.grad` asks for other tensors only."""
    ACCUMULATED = auto()
    """That it is added to `.grad`: `backward()`."""
    RETURNED = auto()
    """The tensor itself: `torch.autograd.grad` asks for it."""


def wanted(parameter: Tensor) -> Wanted:
    """What the backward pass that is running wants with a leaf's gradient."""
    if not parameter.requires_grad:
        return Wanted.NO
    ask = getattr(torch._C, "_will_engine_execute_node", None)
    if ask is None:  # not a public function; without it only backward() is served
        return Wanted.ACCUMULATED
    try:
        return Wanted.ACCUMULATED if ask(get_gradient_edge(parameter).node) else Wanted.NO
    except RuntimeError:  # so it says that torch.autograd.grad asks for this very leaf
        return Wanted.RETURNED


class TableGradient:
    """Gradient buffer of a table, reused from step to step (a fresh 44 MB costs 20 ms in page faults).

    Rows that are not zero are marked, so that clearing and the optimiser need not read the others. Kernels write past
    torch's version counter; if that counter moved, somebody else wrote, and every row counts as marked.
    """

    def __init__(self, table: Tensor):
        self.buffer = torch.zeros_like(table, memory_format=torch.contiguous_format)
        self.marks = torch.zeros(-(-len(table) // 8) * 8, dtype=torch.uint8)
        self._version = self.buffer._version

    @staticmethod
    def known(table: Tensor) -> "TableGradient | None":
        """The buffer that belongs to a table, if there is one."""
        known = getattr(table, "_sl_gradient", None)
        return known if isinstance(known, TableGradient) and known.buffer.shape == table.shape else None

    @staticmethod
    def of(table: nn.Parameter) -> "TableGradient":
        """The buffer that belongs to a table, made at first use; the optimiser finds it here, too."""
        known = TableGradient.known(table)
        if known is None:
            known = table._sl_gradient = TableGradient(table)  # pyright: ignore
        return known

    def attach(self, table: nn.Parameter) -> Tensor:
        """The tensor to add the table's gradient to: `table.grad`, which becomes the (cleared) buffer if it is None."""
        if table.grad is None:
            self.clear()
            table.grad = self.buffer
        elif not self.holds(table.grad):
            return table.grad
        self.trusted_marks()
        return self.buffer

    def holds(self, gradient: Tensor | None) -> bool:
        """Whether a gradient is this buffer."""
        return gradient is not None and gradient.data_ptr() == self.buffer.data_ptr()

    def trusted_marks(self) -> Tensor:
        """Marks of the rows that may hold something: all, if torch wrote to the buffer."""
        if self.buffer._version != self._version:
            self.marks.fill_(1)
            self._version = self.buffer._version
        return self.marks

    def clear(self) -> None:
        """Make the buffer zero."""
        marks, gradient = self.trusted_marks().numpy(), self.buffer.numpy().reshape(-1)

        def work(start: int, stop: int) -> None:
            clear(gradient, marks, start, stop, np.empty(LIST, np.int64))

        parallel([partial(work, start, stop) for start, stop in split(len(self.buffer), 8, 64)])
