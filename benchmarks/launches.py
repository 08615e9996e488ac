"""What the training's loop asks of a GPU: operations that become launches, and waits of the host; no GPU is needed.

    python -m benchmarks.launches [--scan FOLDER] [--backends torch triton] [--output FILE]

Steps of the methods run on a pretended GPU (benchmarks/pretended): tensors say that they are on it and hold their
values on the CPU, and every operation is counted where torch hands it to a device. Kernels in Triton are counted, too,
but do not run, so figures of a training mean nothing here. A large operation of torch, such as a sort, may launch
several kernels. Recorded as a CUDA graph, a step is one launch, besides those that set its scalars. What the loop does
after a step is counted with it.
"""

import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

from benchmarks.common.measuring import Rows, parsed
from benchmarks.common.runs import scan_to_train_on
from benchmarks.common.training import Training, data_of, model_of, settings
from benchmarks.pretended.gpu import PretendedGpu
from benchmarks.pretended.recorder import PretendedRecorder
from sl_nerfstudio.model.loop import WARM_UP

Backend = Literal["torch", "triton"]
METHODS = {"paper": "sl-neus-paper", "default": "sl-neus"}
_COUNTED = 5  # steps; none of them refreshes the cached grid


@dataclass(frozen=True)
class Config:
    """Count launches and waits of a step."""

    scan: Path | None = None  # to train on; by default a small one is made in outputs/bench
    sizes: tuple[str, ...] = ("paper", "default")  # `sl-neus-paper` and `sl-neus`, with their own settings
    backends: tuple[Backend, ...] = ("torch", "triton")  # that compute the field
    rays: int | None = None  # pixels of a step; by default the method's own number. The counts do not depend on it
    output: Path | None = None


@dataclass(frozen=True)
class Row:
    """Figures of one step, unless it says otherwise."""

    size: str
    backend: str
    launches: int  # of most steps
    most: int  # of a step that also writes to the history, every fifth one at first
    of_triton: int  # of these, kernels in Triton
    waits: int  # of the host, most of any step
    between: int  # launches before a step that set its scalars, most of any step
    refresh: int  # launches that refresh the cached grid, every 20 steps; 0 where there is none
    with_graph: int  # launches of most steps that repeat a recording: the graph, and learning rates
    by_name: dict[str, int]


def count(size: str, backend: Backend, config: Config) -> Row:
    """Take some steps, all terms and all levels in use, and count."""
    with PretendedGpu(kernels=backend == "triton", dry=True) as gpu, tempfile.TemporaryDirectory() as folder:
        run = settings(METHODS[size], scan_to_train_on(config.scan), Path(folder), "cuda", 1000)
        run.cuda_graph = False
        model_of(run).sdf.backend = backend
        if config.rays is not None:
            data_of(run).train_num_rays_per_batch = config.rays
        training = Training(run)
        training.done = 601  # rays are rendered, and all levels have their weight
        training.step()
        plain, between = _steps(training, gpu)
        training.trainer.record_steps(PretendedRecorder(gpu))
        for _ in range(WARM_UP + 1):
            training.step()
        repeated, _ = _steps(training, gpu)
        with gpu.counting() as refresh:
            if training.model.config.sampling.strategy == "surface":
                training.model.cache.refresh(training.model.field)
    usual, *_, most = sorted(plain, key=lambda seen: seen.launches.total())
    return Row(
        size, backend, usual.launches.total(), most.launches.total(),
        sum(n for name, n in usual.launches.items() if name.startswith("triton ")),
        max(seen.waits.total() for seen in plain), max(seen.launches.total() for seen in between),
        refresh.launches.total(), min(seen.launches.total() for seen in repeated), dict(usual.launches.most_common()),
    )  # fmt: skip


def _steps(training: Training, gpu: PretendedGpu) -> tuple[list, list]:
    steps, between = [], []
    for _ in range(_COUNTED):
        with gpu.counting() as before:
            training.before()
        with gpu.counting() as step:
            training.iterate()
            training.after()
        steps.append(step)
        between.append(before)
    return steps, between


def main(config: Config) -> list[Row]:
    """Count, print, write."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    rows: Rows[Row] = Rows(config.output)
    for size in config.sizes:
        for backend in config.backends:
            rows.add(count(size, backend, config))
    return rows


if __name__ == "__main__":
    main(parsed(Config, __doc__))
