"""Kernels for GPUs, written in Warp: compiled at first use, launched on their tensors' device and stream, and counted.

The same kernels run on the CPU, where tests compare them with torch. Warp's import takes half a second, so only files
that hold kernels import this one, and they are imported only when a tensor is on a GPU, or on request.
"""

import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import torch
import warp as wp
from torch import Tensor

wp.config.log_level = wp.LOG_WARNING  # else it prints its version, its devices and what it compiles

Argument = Tensor | float | int | Any  # the last one: vectors of Warp
_BLOCK = 64  # threads: some kernels have a thread per ray, and a few hundred rays should keep many multiprocessors busy
_watchers: list[Callable[[str], None]] = []


def kernel(function: Callable[..., None]) -> Any:
    """A kernel without an adjoint of its own, free of the run-time type checks that tests wrap functions in."""
    return wp.kernel(inspect.unwrap(function), enable_backward=False)


def part(function: Callable[..., Any]) -> Any:
    """A function that kernels call."""
    return wp.func(inspect.unwrap(function))


def structure(name: str, module: str, **fields: Any) -> Any:
    """A structure of kernels; as a class it would be wrapped, too."""
    return wp.struct(type(name, (), {"__annotations__": fields, "__module__": module}))


def launch(kernel: wp.Kernel, dim: int | tuple[int, ...], *arguments: Argument) -> None:
    """Run a kernel on its tensors; on a GPU it is only queued, on torch's current stream.

    Nothing is allocated and nothing waits, so that a CUDA graph can capture it once the kernel has run before.
    """
    for watcher in _watchers:
        watcher(kernel.key)
    run(kernel, dim, arguments)


def run(kernel: wp.Kernel, dim: int | tuple[int, ...], arguments: tuple[Argument, ...]) -> None:
    """`launch` without telling those who count; what pretends to be a GPU replaces this function."""
    tensors = [x for x in arguments if isinstance(x, Tensor)]
    device = tensors[0].device
    assert all(x.device == device for x in tensors), f"{kernel.key}: tensors on several devices"
    values = [
        _array(x, argument.type) if isinstance(x, Tensor) else x
        for x, argument in zip(arguments, kernel.adj.args, strict=True)
    ]
    if device.type == "cuda":
        stream = _stream(device.index, torch.cuda.current_stream(device).cuda_stream)
        wp.launch(kernel, dim, values, stream=stream, block_dim=_BLOCK, record_tape=False)
    else:
        wp.launch(kernel, dim, values, device="cpu", record_tape=False)


def obstacle(device: torch.device) -> str | None:
    """Why kernels cannot run on a device, or None if they can."""
    if device.type == "cpu" or wp.is_cuda_available():
        return None
    return (
        f"warp-lang {wp.__version__} finds no driver for {device} that it can use: its ordinary wheel needs an NVIDIA "
        "driver for CUDA 13 (R580 or newer), its wheels with +cu12 in their version serve older ones"
    )


@contextmanager
def launches() -> Iterator[list[str]]:
    """The names of all kernels that are launched in the meantime, in their order."""
    names: list[str] = []
    _watchers.append(names.append)
    try:
        yield names
    finally:
        _watchers.remove(names.append)


def _array(x: Tensor, kind: Any) -> Any:
    return wp.from_torch(x.detach(), dtype=kind.dtype, return_ctype=True)


@lru_cache(maxsize=16)
def _stream(device: int, handle: int) -> wp.Stream:
    return wp.Stream(wp.get_device(f"cuda:{device}"), cuda_stream=handle)
