"""Training steps recorded as a CUDA graph: one launch a step in place of thousands.

A graph repeats the operations of the step that it was recorded from, on the same memory. What changes from step to
step must therefore be in tensors that are written before: sharpness, widths and level weights (the model's buffers),
learning rates (`DeviceRates`), the random numbers' seeds. Where the operations themselves change, a new graph is
recorded.
"""

from collections.abc import Callable, Hashable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol, TypeVar, runtime_checkable

import torch
from torch import Tensor
from torch.optim import Optimizer

from sl_nerfstudio.errors import last_line

WARM_UP = 3  # steps before a recording, so that libraries and constants are there

T = TypeVar("T")


@runtime_checkable
class Recorder(Protocol):
    """What records and repeats operations."""

    def warm_up(self, work: Callable[[], T]) -> T:
        """Do some work in the way in which it will be recorded."""
        ...

    def record(self, work: Callable[[], T]) -> tuple[Callable[[], None], T]:
        """Record some work without doing it: what does it, and the results that it then fills in."""
        ...


class CudaRecorder:
    """Records CUDA graphs. `generators`: those that the work draws from, besides torch's own."""

    def __init__(self, generators: Iterable[torch.Generator]) -> None:
        self._generators = tuple(generators)
        self._stream = torch.cuda.Stream()

    def warm_up(self, work: Callable[[], T]) -> T:
        """On a stream of its own: a recording is made on one, too, and torch ties gradients to the stream."""
        self._stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self._stream):
            result = work()
        torch.cuda.current_stream().wait_stream(self._stream)
        return result

    def record(self, work: Callable[[], T]) -> tuple[Callable[[], None], T]:
        """Raises RuntimeError if the work makes the host wait, or launches something outside of its stream."""
        graph = torch.cuda.CUDAGraph()
        for generator in self._generators:
            graph.register_generator_state(generator)
        with torch.cuda.graph(graph, stream=self._stream):
            result = work()
        return graph.replay, result


class NotRecordedError(RuntimeError):
    """A step could not be recorded; it has not been done."""


class StepGraph:
    """Does steps by a recording, as soon as there is one."""

    def __init__(self, recorder: Recorder, work: Callable[[], Any]) -> None:
        self._recorder = recorder
        self._work = work
        self.forget()

    def forget(self) -> None:
        """Record again: the memory that the recording uses is no longer what counts."""
        self._key: Hashable = None
        self._warm = 0
        self._replay: Callable[[], None] | None = None
        self._result: Any = None

    def step(self, key: Hashable) -> Any:
        """One step and its results, which the next step overwrites; another `key` means other operations.

        Raises NotRecordedError if the step cannot be recorded.
        """
        if key != self._key:
            self.forget()  # first of all it frees the memory of the last recording
            self._key = key
        if self._replay is None and self._warm < WARM_UP:
            self._warm += 1
            return self._recorder.warm_up(self._work)
        if self._replay is None:
            try:
                self._replay, self._result = self._recorder.record(self._work)
            except (RuntimeError, AttributeError) as error:  # of CUDA; of a torch without what is called
                raise NotRecordedError(last_line(error)) from error
        self._replay()
        return self._result


class DeviceRates:
    """Learning rates on the parameters' device. The optimisers' own stay numbers, for schedules and checkpoints."""

    def __init__(self, optimizers: Iterable[Optimizer]) -> None:
        groups = [group for optimizer in optimizers for group in optimizer.param_groups]
        self._groups = [(group, torch.zeros((), device=group["params"][0].device)) for group in groups]

    def update(self) -> None:
        """Write the current rates, for which the host need not wait."""
        for group, rate in self._groups:
            rate.fill_(group["lr"])

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """Optimisers read the rates from the device."""
        numbers: list[float | Tensor] = [group["lr"] for group, _ in self._groups]
        try:
            for group, rate in self._groups:
                group["lr"] = rate
            yield
        finally:
            for (group, _), number in zip(self._groups, numbers, strict=True):
                group["lr"] = number
