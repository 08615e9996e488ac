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


@torch.no_grad()
def average_gradients(parameters: Iterable[nn.Parameter]) -> None:
    """Replace the gradients by their means over all processes."""
    dense: list[Tensor] = []
    for parameter in parameters:
        buffer = TableGradient.known(parameter)
        if buffer is not None and buffer.holds(parameter.grad):
            _average_rows(buffer)
        elif parameter.grad is not None:
            dense.append(parameter.grad)
    if dense:  # one message: the tensors of a perceptron are small
        together = torch.cat([gradient.reshape(-1) for gradient in dense])
        dist.all_reduce(together)
        together /= dist.get_world_size()
        for gradient, mean in zip(dense, together.split([gradient.numel() for gradient in dense]), strict=True):
            gradient.copy_(mean.view_as(gradient))


def _average_rows(buffer: TableGradient) -> None:
    """Only the rows that any process marked: a batch of points touches a part of the table. On a GPU, all rows."""
    if len(buffer.marks) == 0:
        dist.all_reduce(buffer.buffer)
        buffer.buffer /= dist.get_world_size()
        return
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

    def optimizer_scaler_step_some(self, grad_scaler: GradScaler, param_groups: list[str]) -> None:  # pyright: ignore
        """See nerfstudio's Optimizers."""
        average_gradients(parameter for name in param_groups for parameter in self.parameters[name])
        super().optimizer_scaler_step_some(grad_scaler, param_groups)


def shared_optimizers(config: dict[str, Any], parameters: dict[str, list[nn.Parameter]]) -> SharedOptimizers:
    """As nerfstudio's trainer makes them."""
    return SharedOptimizers(config.copy(), parameters)
