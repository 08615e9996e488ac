"""What a training step asks of a GPU: operations that become launches, and waits of the host; no GPU is needed.

python -m benchmarks.launches [--scan FOLDER] [--backends torch warp] [--details] [--output FILE]

Steps of the methods run on a pretended GPU (benchmarks/pretended): tensors say that they are on it and hold their
values on the CPU, and every operation is counted where torch hands it to a device. Kernels in Warp are counted, too. A
large operation of torch, such as a sort, may launch several kernels. Recorded as a CUDA graph, a step is one launch,
besides those that set its scalars.
"""

import tempfile
import warnings
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
import tyro

from benchmarks.common.machine import write_rows
from benchmarks.common.scans import made_once
from benchmarks.common.training import Training, data_of, model_of, settings
from benchmarks.pretended.gpu import PretendedGpu
from benchmarks.pretended.recorder import PretendedRecorder
from sl_nerfstudio.model.loop import WARM_UP
from sl_nerfstudio.synthesis.config import SynthConfig

Backend = Literal["torch", "warp"]
METHODS = {"paper": "sl-neus-paper", "default": "sl-neus"}
_COUNTED = 5  # steps; none of them refreshes the cached grid


@dataclass(frozen=True)
class Config:
    """Count launches and waits of a step."""

    scan: Path | None = None
    """Scan folder to train on; by default a small one is made in outputs/bench."""
    sizes: tuple[Literal["paper", "default"], ...] = ("paper", "default")
    """The methods: `sl-neus-paper` and `sl-neus`, with their own settings."""
    backends: tuple[Backend, ...] = ("torch", "warp")
    """How the field is computed."""
    rays: int | None = None
    """Pixels of a step; by default the method's own number. The counts do not depend on it."""
    details: bool = False
    """Also print the operations by name."""
    output: Path | None = None
    """Where to write the figures as JSON."""


@dataclass(frozen=True)
class Row:
    """Of one step, unless it says otherwise."""

    size: str
    backend: str
    launches: int
    """Of most steps."""
    most: int
    """Of a step that also writes to the history, every fifth one at first."""
    of_warp: int
    """Of these, kernels in Warp."""
    waits: int
    """Times that the host waits, most of any step."""
    between: int
    """Launches before a step that set its scalars, most of any step."""
    refresh: int
    """Launches that refresh the cached grid, every 20 steps; 0 where there is none."""
    with_graph: int
    """Launches of most steps that repeat a recording: the graph, and learning rates."""
    by_name: dict[str, int]


def count(size: str, backend: Backend, config: Config) -> Row:
    """Take some steps, all terms and all levels in use, and count."""
    with PretendedGpu(kernels=backend == "warp") as gpu, tempfile.TemporaryDirectory() as folder:
        run = settings(METHODS[size], _scan(config), Path(folder), "cuda", 1000)
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
        size,
        backend,
        usual.launches.total(),
        most.launches.total(),
        sum(n for name, n in usual.launches.items() if name.startswith("warp ")),
        max(seen.waits.total() for seen in plain),
        max(seen.launches.total() for seen in between),
        refresh.launches.total(),
        min(seen.launches.total() for seen in repeated),
        dict(usual.launches.most_common()),
    )


def _steps(training: Training, gpu: PretendedGpu) -> tuple[list, list]:
    steps, between = [], []
    for _ in range(_COUNTED):
        with gpu.counting() as before:
            training.before()
        with gpu.counting() as step:
            training.iterate()
        steps.append(step)
        between.append(before)
    return steps, between


def _scan(config: Config) -> Path:
    if config.scan is not None:
        return config.scan
    return made_once(SynthConfig(frames=4, resolution=96), Path("outputs/bench")).scan.root


def report(rows: list[Row]) -> str:
    """All rows as a table."""
    lines = [
        f"{'size':10s}{'backend':9s}{'launches':>9s}{'most':>6s}{'of Warp':>9s}{'waits':>7s}"
        f"{'between':>9s}{'refresh':>9s}{'graph':>7s}"
    ]
    for r in rows:
        figures = f"{r.launches:9d}{r.most:6d}{r.of_warp:9d}{r.waits:7d}{r.between:9d}{r.refresh:9d}{r.with_graph:7d}"
        lines.append(f"{r.size:10s}{r.backend:9s}{figures}")
    return "\n".join(lines)


def main(config: Config) -> list[Row]:
    """Count, print, write."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    rows = [count(size, backend, config) for size in config.sizes for backend in config.backends]
    print(report(rows))
    for row in rows if config.details else []:
        print(
            f"\n{row.size}, {row.backend}: {', '.join(f'{name} {n}' for name, n in Counter(row.by_name).most_common())}"
        )
    if config.output is not None:
        write_rows(config.output, rows)
    return rows


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
