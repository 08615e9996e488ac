"""Adam for feature tables: a row is updated only if it has a gradient.

A batch of points touches a fraction of the table. As in Müller et al. (Instant Neural Graphics Primitives, 2022), rows
whose gradient is exactly zero are skipped: moments and bias correction count a row's own steps. On the CPU the skipped
rows are not even read. There and in the kernel for GPUs a step clears the gradient, so that the next backward pass does
not have to. The learning rate may be a tensor, which a CUDA graph of the step reads each time.
"""

import math
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.graph import increment_version
from torch.optim import Optimizer

from sl_nerfstudio.field.backend import TableGradient
from sl_nerfstudio.field.device_kernels import obstacle
from sl_nerfstudio.field.numba_grid import LIST, adam
from sl_nerfstudio.parallel import parallel, split

Betas = tuple[float, float]


class RowAdam(Optimizer):
    """Adam that skips the rows (first dimension) of a parameter whose gradient is exactly zero."""

    def __init__(self, params: Any, lr: float | Tensor = 1e-2, betas: Betas = (0.9, 0.99), eps: float = 1e-15) -> None:
        super().__init__(params, {"lr": lr, "betas": betas, "eps": eps})
        self._uploaded: dict[Any, Tensor] = {}  # corrections by device: copied once

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:  # pyright: ignore
        """Take one step for all rows that have a gradient; returns the closure's value."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None:
                    beta1, beta2 = group["betas"]  # a list, perhaps, if a file was read
                    self._step(parameter, group["lr"], (beta1, beta2), group["eps"])
        return loss

    def state_dict(self) -> dict[str, Any]:  # pyright: ignore
        """As torch's, but only with the rows that any step has touched: the others are zero."""
        whole = super().state_dict()
        return {**whole, "state": {key: _packed(state) for key, state in whole["state"].items()}}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue from a state, packed or whole."""
        states = {key: _unpacked(state) for key, state in state_dict["state"].items()}
        super().load_state_dict({**state_dict, "state": states})

    def _step(self, parameter: nn.Parameter, lr: float | Tensor, betas: Betas, eps: float) -> None:
        state = self.state[parameter]
        if not state:
            state["moments"] = parameter.new_zeros(len(parameter), 2, *parameter.shape[1:])  # mean, mean square
            state["steps"] = torch.zeros(len(parameter), device=parameter.device)
        buffer = TableGradient.known(parameter)
        if buffer is not None and not buffer.holds(parameter.grad):
            buffer = None
        if _device_kernel_can(parameter):
            _step_device(parameter, state, lr, betas, eps)
            if buffer is not None:
                buffer.note_zero()
        elif buffer is not None and parameter.device.type == "cpu":
            _step_marked(parameter, buffer, state, lr, betas, eps)
        else:
            key = (parameter.device, betas)
            if key not in self._uploaded:
                self._uploaded[key] = torch.from_numpy(_corrections(betas)).to(parameter.device)
            _step_any(parameter, state, self._uploaded[key], lr, betas, eps)


def _packed(state: dict[str, Tensor]) -> dict[str, Any]:
    steps = state["steps"]
    touched = steps.nonzero()[:, 0]
    return {
        "rows": len(steps),
        "touched": touched.to(torch.int32),
        "moments": state["moments"][touched],
        "steps": steps[touched].to(torch.int32),
    }


def _unpacked(state: dict[str, Any]) -> dict[str, Tensor]:
    if "touched" not in state:
        return state
    touched, some = state["touched"].long(), state["moments"]
    moments, steps = some.new_zeros(state["rows"], *some.shape[1:]), some.new_zeros(state["rows"])
    moments[touched], steps[touched] = some, state["steps"].to(some)
    return {"moments": moments, "steps": steps}


@lru_cache(maxsize=4)
def _corrections(betas: Betas) -> np.ndarray:
    """Row t: factors that correct step t's moments for their start at zero; constant from the last row on."""
    until = max(math.log(2**-24) / math.log(beta) if 0 < beta < 1 else 1 for beta in betas)
    t = np.arange(1, math.ceil(until) + 1)
    rows = np.stack([1 / (1 - betas[0] ** t), np.sqrt(1 / (1 - betas[1] ** t))], -1)
    return np.concatenate([np.ones((1, 2)), rows]).astype(np.float32)


def _step_marked(
    parameter: Tensor, buffer: TableGradient, state: dict[str, Tensor], lr: float | Tensor, betas: Betas, eps: float
) -> None:
    """The compiled step of a table whose gradient is in its persistent buffer."""
    marks = buffer.trusted_marks().numpy()
    arrays = [t.detach().numpy().reshape(-1) for t in (parameter, buffer.buffer, state["moments"], state["steps"])]
    constants = [_corrections(betas), *(np.float32(x) for x in (lr, *betas, eps))]

    def work(start: int, stop: int) -> None:
        adam(*arrays, marks, start, stop, np.empty(LIST, np.int64), *constants)

    parallel([partial(work, start, stop) for start, stop in split(len(parameter), 16, 64)])
    increment_version(parameter)


def _device_kernel_can(parameter: Tensor) -> bool:
    """Whether a table is on a GPU for which there is a kernel."""
    row = (parameter.dtype, *parameter.shape[1:])
    return parameter.device.type == "cuda" and row == (torch.float32, 8) and obstacle(parameter.device) is None


def _step_device(
    parameter: nn.Parameter, state: dict[str, Tensor], lr: float | Tensor, betas: Betas, eps: float
) -> None:
    """The step as one kernel; clears the gradient."""
    from sl_nerfstudio.field.triton_backend import step_table

    assert parameter.grad is not None
    rate = lr.reshape(1) if isinstance(lr, Tensor) else torch.full((1,), lr, device=parameter.device)
    most = len(_corrections(betas)) - 1
    step_table(parameter, parameter.grad, state["moments"], state["steps"], rate, betas, most, eps)
    increment_version([parameter, parameter.grad])


def _step_any(
    parameter: nn.Parameter,
    state: dict[str, Tensor],
    corrections: Tensor,
    lr: float | Tensor,
    betas: Betas,
    eps: float,
) -> None:
    """The same step in torch, for any device, shape and precision."""
    g, steps = parameter.grad, state["steps"]
    mean, square = state["moments"].unbind(1)
    assert g is not None
    some = (g != 0).reshape(len(g), -1).any(1)
    shape = (-1,) + (1,) * (g.ndim - 1)
    mean.copy_(mean.lerp(g, 1 - betas[0]).where(some.view(shape), mean))
    square.copy_(square.lerp(g * g, 1 - betas[1]).where(some.view(shape), square))
    steps.add_(some).clamp_max_(len(corrections) - 1)
    rate, root = corrections.to(g)[steps.long()].unbind(-1)
    step = lr * rate.view(shape) * mean / (square.sqrt() * root.view(shape) + eps)
    parameter.sub_(step.where(some.view(shape), torch.zeros_like(step)))
