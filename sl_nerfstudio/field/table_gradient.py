"""The table's gradient: one buffer for the whole run, with marks on the rows that may not be zero."""

from enum import Enum, auto
from functools import partial

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.graph import get_gradient_edge

from sl_nerfstudio.field.kernels.rows import LIST, clear
from sl_nerfstudio.threads import parallel, split


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

    def put(self, marks: Tensor, rows: Tensor, values: Tensor) -> None:
        """Replace rows; `marks` are those of all rows that may not be zero from now on."""
        self.buffer[rows] = values
        self.marks.copy_(marks)
        self._version = self.buffer._version

    def move(self, buffer: Tensor, marks: Tensor) -> None:
        """Continue in other memory, of the same shapes; the table's `grad` must be set to it by the caller."""
        buffer.copy_(self.buffer)
        marks.copy_(self.trusted_marks())
        self.buffer, self.marks, self._version = buffer, marks, buffer._version

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
