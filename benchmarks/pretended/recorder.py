"""A recording of operations on the pretended GPU, repeated as a CUDA graph repeats its own."""

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from benchmarks.pretended.gpu import PretendedGpu, launches, on_cpu

T = TypeVar("T")


class PretendedRecorder:
    """A `Recorder`: operations are repeated with the tensors and numbers that they had, into the same memory.

    Python code does not run again, so a number that it would have computed anew stays what it was.
    """

    def __init__(self, gpu: PretendedGpu) -> None:
        self._gpu = gpu
        self.recordings = 0
        self.replays = 0

    def warm_up(self, work: Callable[[], T]) -> T:
        """Do the work."""
        return work()

    def record(self, work: Callable[[], T]) -> tuple[Callable[[], None], T]:
        """Raises RuntimeError if the host waits. Unlike CUDA it does the work; the first repetition is left out."""
        tape = _Tape()
        self._gpu.on_kernel.append(tape.work.append)
        try:
            with self._gpu.counting() as seen, tape:
                result = work()
        finally:
            self._gpu.on_kernel.remove(tape.work.append)
        if seen.waits:
            raise RuntimeError(f"operation not permitted when stream is capturing: {next(iter(seen.waits))}")
        self.recordings += 1
        done = iter([True])

        def replay() -> None:
            self.replays += 1
            self._gpu.seen.launches["graph"] += 1
            if not next(done, False):
                with self._gpu.counting():  # not one by one
                    tape.repeat()

        return replay, result


class _Tape(TorchDispatchMode):
    """All operations that change memory, with what they got and what they gave."""

    def __init__(self) -> None:
        super().__init__()
        self.work: list[Callable[[], None]] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Do it, and note it."""
        out = func(*args, **(kwargs or {}))
        if launches(func):
            self.work.append(partial(_again, func, args, kwargs or {}, out))
        return out

    @torch.no_grad()
    def repeat(self) -> None:
        """Do all of them again, into the same memory."""
        for work in self.work:
            work()


def _again(func: Any, args: Any, kwargs: Any, out: Any) -> None:
    for old, new in zip(tree_leaves(out), tree_leaves(func(*args, **kwargs)), strict=True):
        if isinstance(old, Tensor) and old is not new:
            on_cpu(old).view(new.shape).copy_(on_cpu(new))  # its shape may have been changed in place
