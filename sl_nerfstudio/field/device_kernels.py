"""Kernels for GPUs, written in Triton: whether they can run, and how they are launched and counted.

Triton comes with torch on Linux; nothing of it is imported before a tensor is on a GPU. With TRITON_INTERPRET=1 in the
environment the same kernels run on the CPU, slowly: tests compare them with torch in double precision.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor

from sl_nerfstudio.errors import last_line

INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
_INTERPRETED_AT_ONCE = 4096  # elements of a block: an interpreted program takes as long, however small it is
_watchers: list[Callable[[str], None]] = []
_failures: list[str] = []


def launch(kernel: Any, programs: int | tuple[int, int], *arguments: Tensor | float | int, **constants: Any) -> None:
    """Queue a kernel on its tensors' GPU, on torch's current stream.

    Nothing is allocated and nothing waits, so that a CUDA graph can capture it once it was compiled. Without programs
    nothing is done. The constants are part of the compiled kernel, as is `num_warps`. Tensors must have no gaps, unless
    the kernel has STRIDES.
    """
    grid = (programs,) if isinstance(programs, int) else programs
    if 0 in grid:
        return
    dense = "STRIDES" in constants or all(x.is_contiguous() for x in arguments if isinstance(x, Tensor))
    assert dense, f"{name_of(kernel)}: a tensor with gaps"
    for watcher in _watchers:
        watcher(name_of(kernel))
    run(kernel, grid, arguments, constants)


def run(kernel: Any, grid: tuple[int, ...], arguments: tuple[Any, ...], constants: dict[str, Any]) -> None:
    """`launch` without telling those who count; what pretends to be a GPU replaces this function."""
    tensors = [x for x in arguments if isinstance(x, Tensor)]
    device = tensors[0].device
    assert all(x.device == device for x in tensors), f"{name_of(kernel)}: tensors on several devices"
    arguments = tuple(x.detach() if isinstance(x, Tensor) else x for x in arguments)
    if device.type == "cuda":
        with torch.cuda.device(device):
            kernel[grid](*arguments, **constants)
    else:
        kernel[grid](*arguments, **constants)


def name_of(kernel: Any) -> str:
    """The name of a kernel, compiled or interpreted."""
    return kernel.fn.__name__


def block(usual: int, n: int) -> int:
    """How many of n elements one program takes: the usual number, more if programs are interpreted."""
    if not INTERPRETED:
        return usual
    return max(usual, min(1 << max(n - 1, 0).bit_length(), _INTERPRETED_AT_ONCE))


def obstacle(device: torch.device) -> str | None:
    """Why kernels cannot run on a device, or None if they can. The first call for a GPU compiles a tiny one."""
    if device.type == "cpu" and not INTERPRETED:
        return "the triton backend runs on a GPU; on the CPU only with TRITON_INTERPRET=1 in the environment"
    return _failures[0] if _failures else _tried(device)


def give_up(error: BaseException) -> str:
    """From now on plain torch is used, because a kernel failed; returns why, in words."""
    _failures[:] = [_why(error)]
    return _failures[0]


@cache
def _tried(device: torch.device) -> str | None:
    if find_spec("triton") is None:
        return "the triton backend needs the package triton, which comes with torch on Linux"
    try:
        from sl_nerfstudio.field.triton_vectors import probe

        x = torch.ones(1, device=device)
        run(probe, (1,), (x,), {})
        if float(x) != 2.0:
            return "Triton compiles a kernel that computes something else"
    except Exception as error:  # whatever a driver, a C compiler or a broken installation does
        return _why(error)
    return None


def _why(error: BaseException) -> str:
    said = f"Triton cannot compile or run kernels here ({type(error).__name__}: {last_line(error)})"
    if isinstance(error, OSError):
        return f"{said}; TRITON_CACHE_DIR may name a folder that can be written"
    return f"{said}; it needs a driver for torch's CUDA, and a C compiler"


@contextmanager
def launches() -> Iterator[list[str]]:
    """The names of all kernels that are launched in the meantime, in their order."""
    names: list[str] = []
    _watchers.append(names.append)
    try:
        yield names
    finally:
        _watchers.remove(names.append)
