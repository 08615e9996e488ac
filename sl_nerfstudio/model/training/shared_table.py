"""The gradient of a feature table in memory that all processes of one machine see, and its mean over them.

Sent through a socket, the rows that a step touches take as long as the step. Here every process writes its gradient to
memory of its own that the others see; then each of them averages a part of the rows for all. Sums are in the order of
the processes, so that all find the same bits.
"""

import mmap
import os
import secrets
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from jaxtyping import Float32, UInt8
from numpy import ndarray

from sl_nerfstudio.field.kernels.rows import LIST, average
from sl_nerfstudio.field.table_gradient import TableGradient
from sl_nerfstudio.threads import parallel, split

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
