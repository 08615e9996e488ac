"""What the processes of one training share: their start, the mean of their gradients, and when to stop.

torch's DistributedDataParallel averages the gradients of what a module's `forward` computed. Here most losses are
computed after it, and kernels write the table's gradient themselves; so gradients are averaged before each step of the
optimisers instead, with the same result: each process draws its own pixels, and all of them take the same step.
"""

import logging
import mmap
import os
import secrets
import signal
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from jaxtyping import Float32, UInt8
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.utils import comms
from numpy import ndarray
from torch import Tensor, nn
from torch.cuda.amp.grad_scaler import GradScaler
from torch.multiprocessing.spawn import ProcessExitedException

from sl_nerfstudio.field.backend import TableGradient
from sl_nerfstudio.field.numba_grid import LIST, average
from sl_nerfstudio.model.run_files import quiet_nerfstudio
from sl_nerfstudio.parallel import cores, parallel, split

# Several processes for one training: nerfstudio's launcher, on CPUs as well, and ended by a signal without loss.

_TRAIN = "nerfstudio.scripts.train"


def launch_well() -> None:
    """Let `ns-train` start the processes of a training with `launch`."""
    if _TRAIN in sys.modules:
        sys.modules[_TRAIN].launch = launch  # type: ignore[attr-defined]


def launch(
    main_func: Callable[..., Any],
    num_devices_per_machine: int,
    num_machines: int,
    machine_rank: int,
    dist_url: str,
    config: Any,
    device_type: str,
) -> None:
    """nerfstudio's launcher with three differences.

    - `device_type` may be `cpu`: the processes then share the cores, and speak through gloo.
    - SIGINT and SIGTERM reach the first process, which ends the run together with the others (see training/loop.py);
      the status is 130 or 143.
    - The message of a process that failed stands alone, without this one's traceback.
    """
    from nerfstudio.scripts.train import _find_free_port

    logging.getLogger("torch.multiprocessing.spawn").setLevel(logging.ERROR)  # it warns when it ends the others
    url = f"tcp://127.0.0.1:{_find_free_port()}" if dist_url == "auto" else dist_url
    ranks = (num_devices_per_machine, num_machines, machine_rank)
    context = mp.spawn(_work, (main_func, *ranks, url, config, device_type), nprocs=num_devices_per_machine, join=False)
    assert context is not None
    first = context.processes[0]
    assert first is not None
    with _signals_forwarded_to(first) as received:
        try:
            while not context.join():
                pass
        except ProcessExitedException as error:
            raise SystemExit(128 + received[0] if received else error.exit_code) from None
        finally:
            config.leave_folder()


@contextmanager
def _signals_forwarded_to(process: BaseProcess) -> Iterator[list[int]]:
    """Send SIGTERM to a process for each SIGINT or SIGTERM; holds their numbers."""
    received: list[int] = []

    def forward(number: int, frame: Any) -> None:
        received.append(number)
        process.terminate()

    before = {number: signal.signal(number, forward) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _work(
    local_rank: int,
    main_func: Callable[..., Any],
    devices: int,
    machines: int,
    machine_rank: int,
    url: str,
    config: Any,
    device_type: str,
) -> None:
    """One process, until its training ends."""
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # a terminal sends it to all processes; the one that started them forwards it
    quiet_nerfstudio(not config.verbose)
    if device_type == "cuda":
        torch.cuda.set_device(local_rank)
    else:
        torch.set_num_threads(max(cores() // devices, 1))
    rank = machine_rank * devices + local_rank
    backend = "nccl" if device_type == "cuda" else "gloo"
    dist.init_process_group(backend, init_method=url, world_size=machines * devices, rank=rank)
    for machine in range(machines):  # every process takes part in making every group
        group = dist.new_group(list(range(machine * devices, (machine + 1) * devices)))
        if machine == machine_rank:
            comms.LOCAL_PROCESS_GROUP = group  # type: ignore[assignment]
    main_func(local_rank, machines * devices, config, rank)
    comms.synchronize()
    dist.destroy_process_group()


# The gradient of a feature table in memory that all processes of one machine see, and its mean over them.
#
# Sent through a socket, the rows that a step touches take as long as the step. Here every process writes its
# gradient to
# memory of its own that the others see; then each of them averages a part of the rows for all. Sums are in the
# order of
# the processes, so that all find the same bits.

_TOKEN = 64  # bytes at the start by which the processes know the memory


class SharedTable:
    """Gradients and marks of a table, of all processes."""

    def __init__(self, memory: mmap.mmap, buffer: TableGradient):
        """Move this process's buffer to its part of the memory, which is that of all processes."""
        count, (rows, features) = dist.get_world_size(), buffer.buffer.shape
        self._rows = rows
        whole = np.frombuffer(memory, np.uint8)[_TOKEN:]
        size = 4 * rows * features
        self._gradients: Float32[ndarray, "processes entries"] = (
            whole[: count * size].view(np.float32).reshape(count, -1)
        )
        self._marks: UInt8[ndarray, "processes marks"] = whole[count * size :].reshape(count, -1)
        own = dist.get_rank()
        buffer.move(torch.from_numpy(self._gradients[own]).view(rows, features), torch.from_numpy(self._marks[own]))

    @staticmethod
    def of(buffer: TableGradient) -> "SharedTable | None":
        """Shared memory for a buffer; None in all processes unless all of them are on one machine that offers it.

        All processes must call this together.
        """
        memory, size = None, _TOKEN + dist.get_world_size() * (buffer.buffer.nbytes + buffer.marks.nbytes)
        described: list[Any] = [_made(size) if dist.get_rank() == 0 else None]
        made = described[0]
        dist.broadcast_object_list(described, 0)
        if described[0] is not None:
            memory = _opened(described[0][0], described[0][1], size)
        all_have = torch.tensor(int(memory is not None))
        dist.all_reduce(all_have, dist.ReduceOp.MIN)
        if made is not None:
            os.close(made[2])
        return SharedTable(memory, buffer) if memory is not None and all_have else None

    def average(self) -> None:
        """Replace the rows that any process marked by their means, in all processes; their marks become the same.

        All processes must call this after all have written, and wait for each other before the next backward pass.
        """
        own, count = dist.get_rank(), dist.get_world_size()

        def work(start: int, stop: int) -> None:
            average(self._gradients, self._marks, start, stop, np.empty(LIST, np.int64), own, count)

        parallel([partial(work, start, stop) for start, stop in split(self._rows, 8, LIST * count)])


def _made(size: int) -> tuple[str, bytes, int] | None:
    """Memory without a name: the path by which others open it, a token that it begins with, and its file descriptor."""
    create = getattr(os, "memfd_create", None)
    if create is None:  # not Linux
        return None
    descriptor, token = create("sl-nerfstudio-gradients"), secrets.token_bytes(_TOKEN)
    os.truncate(descriptor, size)
    os.pwrite(descriptor, token, 0)
    return f"/proc/{os.getpid()}/fd/{descriptor}", token, descriptor


def _opened(path: str, token: bytes, size: int) -> mmap.mmap | None:
    """The memory of another process; None if it is not there, as for a process of another machine or container."""
    try:
        with Path(path).open("r+b") as file:
            memory = mmap.mmap(file.fileno(), size)
    except (OSError, ValueError):
        return None
    return memory if memory[:_TOKEN] == token else None


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
