"""What the processes of one training share: their start, the mean of their gradients, and when to stop.

torch's DistributedDataParallel averages the gradients of what a module's `forward` computed. Here most losses are
computed after it, and kernels write the table's gradient themselves; so gradients are averaged before each step of the
optimisers instead, with the same result: each process draws its own pixels, and all of them take the same step.
"""

from collections.abc import Iterable
from typing import Any

import torch
import torch.distributed as dist
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.utils import comms
from torch import Tensor, nn
from torch.cuda.amp.grad_scaler import GradScaler

from sl_nerfstudio.field.table_gradient import TableGradient
from sl_nerfstudio.model.training.shared_table import SharedTable


def several() -> bool:
    """Whether this process trains together with others."""
    return comms.get_world_size() > 1


@torch.no_grad()
def share_state(module: nn.Module) -> None:
    """Give all processes the parameters and saved buffers of the main one."""
    for tensor in module.state_dict().values():
        whole = tensor.contiguous()
        dist.broadcast(whole, 0)
        if whole is not tensor:
            tensor.copy_(whole)


class MeanGradients:
    """Replaces gradients by their means over all processes."""

    def __init__(self) -> None:
        self._shared: dict[TableGradient, SharedTable | None] = {}

    @torch.no_grad()
    def __call__(self, parameters: Iterable[nn.Parameter]) -> None:
        """Once in every step; all processes call this with the same parameters."""
        dense: list[Tensor] = []
        shared: list[SharedTable] = []
        for parameter in parameters:
            buffer = TableGradient.known(parameter)
            if buffer is None or not buffer.holds(parameter.grad):
                dense += [] if parameter.grad is None else [parameter.grad]
            elif len(buffer.marks) == 0:  # on a GPU: all rows
                dist.all_reduce(buffer.buffer)
                buffer.buffer /= dist.get_world_size()
            elif (table := self._shared_table(parameter, buffer)) is not None:
                buffer.trusted_marks()
                shared.append(table)
            else:
                _average_rows(buffer)
        _average_dense(dense)  # all processes have come here when one has the result
        for table in shared:
            table.average()
        if shared:
            dist.barrier()  # before one of them writes gradients again

    def _shared_table(self, parameter: nn.Parameter, buffer: TableGradient) -> SharedTable | None:
        if buffer not in self._shared:
            self._shared[buffer] = SharedTable.of(buffer)
            parameter.grad = buffer.buffer
        return self._shared[buffer]


def _average_dense(gradients: list[Tensor]) -> None:
    """In one message, because the tensors of a perceptron are small; without any, wait for the others."""
    if not gradients:
        dist.barrier()
        return
    together = torch.cat([gradient.reshape(-1) for gradient in gradients])
    dist.all_reduce(together)
    together /= dist.get_world_size()
    for gradient, mean in zip(gradients, together.split([gradient.numel() for gradient in gradients]), strict=True):
        gradient.copy_(mean.view_as(gradient))


def _average_rows(buffer: TableGradient) -> None:
    """Only the rows that any process marked: a batch of points touches a part of the table."""
    marks = buffer.trusted_marks().clone()
    dist.all_reduce(marks, dist.ReduceOp.MAX)
    rows = marks[: len(buffer.buffer)].nonzero()[:, 0]
    values = buffer.buffer[rows]
    dist.all_reduce(values)
    buffer.put(marks, rows, values / dist.get_world_size())


def greatest(number: int, device: str) -> int:
    """The greatest of a small number over all processes."""
    shared = torch.tensor(number, dtype=torch.int32, device=device)
    dist.all_reduce(shared, dist.ReduceOp.MAX)
    return int(shared)


class SharedOptimizers(Optimizers):
    """nerfstudio's optimisers, which step along the mean of all processes' gradients.

    The mean is taken before a gradient scaler looks for infinities, so that all processes find the same.
    """

    def __init__(self, config: dict[str, Any], param_groups: dict[str, list[nn.Parameter]]) -> None:
        super().__init__(config, param_groups)
        self._average = MeanGradients()

    def optimizer_scaler_step_some(self, grad_scaler: GradScaler, param_groups: list[str]) -> None:  # pyright: ignore
        """See nerfstudio's Optimizers."""
        self._average(parameter for name in param_groups for parameter in self.parameters[name])
        super().optimizer_scaler_step_some(grad_scaler, param_groups)


def shared_optimizers(config: dict[str, Any], parameters: dict[str, list[nn.Parameter]]) -> SharedOptimizers:
    """As nerfstudio's trainer makes them."""
    return SharedOptimizers(config.copy(), parameters)
