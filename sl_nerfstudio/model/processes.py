"""What the processes of one training, one on each GPU, share: a start, the mean of their gradients, and an end.

nerfstudio starts them (`--machine.num-devices`), and would wrap the model in torch's DistributedDataParallel. That
averages the gradients of what a module's `forward` computed; here most losses are computed after it, and kernels write
the table's gradient themselves. So gradients are averaged before each step of the optimisers, with the same result:
each process draws its own pixels, and all of them take the same step.
"""

from typing import Any

import torch
import torch.distributed as dist
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.utils import comms
from torch import nn


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


def greatest(number: int, device: str) -> int:
    """The greatest of a small number over all processes."""
    shared = torch.tensor(number, dtype=torch.int32, device=device)
    dist.all_reduce(shared, dist.ReduceOp.MAX)
    return int(shared)


class SharedOptimizers(Optimizers):
    """nerfstudio's optimisers, which step along the mean of all processes' gradients.

    The mean is taken before a gradient scaler looks for infinities, so that all processes find the same.
    """

    @torch.no_grad()
    def optimizer_scaler_step_some(self, grad_scaler: Any, param_groups: list[str]) -> None:
        """See nerfstudio's Optimizers."""
        for parameter in (parameter for name in param_groups for parameter in self.parameters[name]):
            if parameter.grad is not None:
                dist.all_reduce(parameter.grad)
                parameter.grad /= dist.get_world_size()
        super().optimizer_scaler_step_some(grad_scaler, param_groups)
