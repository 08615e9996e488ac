"""Every kernel for GPUs, compiled as a training launches it, for GPUs that are not there: registers and spills.

    python -m benchmarks.kernels [--scan FOLDER] [--architectures 80 89 90] [--output FILE]

Steps of both methods run on the CPU, and each kernel that they would launch is compiled with the types, alignments and
constants of that launch, but does not run. `ptxas`, which comes with Triton, then says what a thread needs. A spill is
a register that does not fit and is kept in memory.
"""

import re
import subprocess
import tempfile
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from torch import Tensor

from benchmarks.common.measuring import Rows, parsed
from benchmarks.common.runs import scan_to_train_on
from benchmarks.common.training import Training, model_of, settings
from sl_nerfstudio.field import backend, device_kernels
from sl_nerfstudio.field.device_kernels import name_of
from sl_nerfstudio.field.optimiser import RowAdam, _step_device
from sl_nerfstudio.model.kernel_step import kernel_step

_METHODS = ("sl-neus", "sl-neus-paper")


@dataclass(frozen=True)
class Config:
    """Compile all kernels."""

    scan: Path | None = None  # to train on; by default a small one is made in outputs/bench
    architectures: tuple[int, ...] = (80, 89, 90)  # A100, RTX 40 and L40, H100
    output: Path | None = None


@dataclass(frozen=True)
class Row:
    """A kernel on an architecture; of all its variants the worst figures."""

    kernel: str
    architecture: int
    variants: int  # different launches: other constants or alignments
    registers: int  # of a thread; 255 are the most that there are
    spills: int  # bytes of a thread
    vectors: int  # loads, stores and additions of 16 bytes in its code, fewest of all variants
    shared: int  # bytes of memory of a program that its threads share
    seconds: float  # to compile all variants


class NoGpu:
    """What Triton asks of a driver before it compiles."""

    def __init__(self, architecture: int) -> None:
        self.architecture = architecture

    def get_current_target(self) -> Any:
        """The GPU to compile for."""
        from triton.backends.compiler import GPUTarget

        return GPUTarget("cuda", self.architecture, 32)

    def get_current_device(self) -> int:
        """Its number."""
        return 0

    def get_current_stream(self, _: int = 0) -> int:
        """Its default stream."""
        return 0


Launch = tuple[Any, tuple[int, ...], tuple[Any, ...], dict[str, Any]]


def launches_of_a_step(method: str, scan: Path) -> list[Launch]:
    """All launches of a method's step before and while it renders, and of the table's optimiser."""
    found: list[Launch] = []
    with (
        tempfile.TemporaryDirectory() as folder,
        mock.patch.object(device_kernels, "run", lambda *launch: found.append(launch)),
        mock.patch.object(backend, "obstacle", lambda _: None),
    ):
        run = settings(method, scan, Path(folder), "cpu", 1000)
        model_of(run).sdf.backend = "triton"
        training = Training(run)
        sampler, table = training.pipeline.datamanager.train_pixel_sampler, training.model.field.encoding.table
        for renders in (False, True):
            terms, _ = kernel_step(training.model, sampler.samples, sampler.choose(0), renders)
            torch.stack(list(terms.values())).sum().backward()
        training.model.cache.refresh(training.model.field)
        state = {"moments": torch.zeros(len(table), 2, 8), "steps": torch.zeros(len(table))}
        _step_device(table, state, 0.01, RowAdam([table]).param_groups[0]["betas"], 1e-15)
    return found


def compiled(launches: list[Launch], architecture: int) -> list[Row]:
    """Compile all launches for an architecture."""
    from triton.runtime import driver

    driver.set_active(NoGpu(architecture))  # pyright: ignore[reportArgumentType]  # as much of one as compiling needs
    for kernel, *_ in launches:
        kernel.device_caches.clear()  # they hold what was compiled for the last one
    found: dict[str, dict[str, tuple[int, int, int, int]]] = {}
    seconds: dict[str, float] = {}
    for kernel, grid, arguments, constants in launches:
        begin, name = time.perf_counter(), name_of(kernel)
        plain = tuple(x.detach() if isinstance(x, Tensor) else x for x in arguments)
        made = kernel.warmup(*plain, grid=grid, **constants)
        ptx = made.asm["ptx"]
        vectors = len(re.findall(r"global\.\S*v4\.", ptx))
        found.setdefault(name, {})[made.hash] = *resources(ptx, architecture), -vectors, made.metadata.shared
        seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - begin
    rows = []
    for name, variants in found.items():
        registers, spills, vectors, shared = (max(column) for column in zip(*variants.values(), strict=True))
        figures = (registers, spills, -vectors, shared, round(seconds[name], 2))
        rows.append(Row(name, architecture, len(variants), *figures))
    return rows


def resources(ptx: str, architecture: int) -> tuple[int, int]:
    """Registers, and bytes of spills, of a thread."""
    from triton.backends.nvidia.compiler import get_ptxas, sm_arch_from_capability

    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "kernel.ptx"
        source.write_text(ptx)
        words = [get_ptxas(architecture).path, "-v", f"--gpu-name={sm_arch_from_capability(architecture)}", str(source)]
        said = subprocess.run([*words, "-o", "/dev/null"], check=True, capture_output=True, text=True).stderr
    return int(re.findall(r"Used (\d+) registers", said)[0]), int(re.findall(r"(\d+) bytes spill stores", said)[0])


def main(config: Config) -> list[Row]:
    """Compile, print, write."""
    if device_kernels.INTERPRETED:
        raise SystemExit("TRITON_INTERPRET=1 is set: kernels would not be compiled")
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    scan = scan_to_train_on(config.scan)
    launches = [launch for method in _METHODS for launch in launches_of_a_step(method, scan)]
    rows: Rows[Row] = Rows(config.output)
    for architecture in config.architectures:
        for row in compiled(launches, architecture):
            rows.add(row)
    return rows


if __name__ == "__main__":
    main(parsed(Config, __doc__))
