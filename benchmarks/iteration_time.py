"""Time of one training step: ours, nerfstudio's torch HashEncoding with the same MLP, and the machine's lower bound.

python -m benchmarks.iteration_time [--sizes paper lean] [--rounds 15] [--output benchmarks/results/iteration_time.json]

The variants take turns, one step each, so that other load on the machine affects all of them equally.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # spinning threads would slow down the next variant

import json
import re
import resource
import statistics
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
import tyro

from benchmarks.common.iteration_step import SIZES, VARIANTS
from benchmarks.common.machine import describe
from benchmarks.common.roofline import Floor, Machine, floor_of, measure_machine


@dataclass(frozen=True)
class Config:
    """Time of one whole training step."""

    sizes: tuple[str, ...] = ("paper", "lean")
    """Sizes of the step: paper (2024 rays x 64 samples), lean (1024 x 16)."""
    rounds: int = 15
    """Timed steps of each variant, after two that are not timed."""
    threads: int = 0
    """Number of threads; 0: as many as there are cores."""
    output: Path | None = None
    """Where to write the figures as JSON."""
    memory_of: str | None = None
    """Only run this variant of the first size for three steps, and print the peak memory of the process in MB."""


@dataclass(frozen=True)
class Row:
    """Milliseconds per step."""

    size: str
    variant: str
    median: float
    best: float
    quartiles: tuple[float, float]
    peak_memory_mb: float
    """Peak memory of a process that does nothing else, including everything it imports."""


def measure(size: str, rounds: int, threads: int) -> list[Row]:
    """Time all variants in turn."""
    jobs = {name: make(SIZES[size]) for name, make in VARIANTS.items()}
    times: dict[str, list[float]] = {name: [] for name in jobs}
    for turn in range(rounds + 2):
        for name, job in jobs.items():
            start = time.perf_counter()
            job.step()
            if turn >= 2:
                times[name].append((time.perf_counter() - start) * 1e3)
    rows = []
    for name, values in times.items():
        low, _, high = statistics.quantiles(values, n=4)
        rows.append(Row(size, name, statistics.median(values), min(values), (low, high), _memory(size, name, threads)))
    return rows


def _memory(size: str, variant: str, threads: int) -> float:
    command = [sys.executable, "-m", "benchmarks.iteration_time", "--sizes", size, "--memory-of", variant]
    done = subprocess.run([*command, "--threads", str(threads)], capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1])


def _peak_memory_mb() -> float:
    """Peak memory of this process; `getrusage` would include the process that started it."""
    status = Path("/proc/self/status")
    if status.is_file():
        return int(re.search(r"VmHWM:\s+(\d+) kB", status.read_text())[1]) / 1024  # pyright: ignore
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20  # macOS, in bytes


def report(rows: list[Row], floor: Floor, machine: Machine) -> str:
    """The results of one size as a table."""
    ours = next(row for row in rows if row.variant == "ours")
    lines = [
        f"{ours.size}: {SIZES[ours.size]}",
        f"{'':28s}{'median':>9s}{'best':>9s}{'quartiles':>19s}{'x ours':>8s}{'x bound':>9s}{'peak MB':>9s}",
    ]
    for row in rows:
        quartiles = "{:.1f} .. {:.1f}".format(*row.quartiles)
        lines.append(
            f"{row.variant:28s}{row.median:9.1f}{row.best:9.1f}{quartiles:>19s}{row.median / ours.median:8.1f}"
            f"{row.best / floor.total_ms:9.2f}{row.peak_memory_mb:9.0f}"
        )
    lines.append(
        f"lower bound {floor.total_ms:.1f} ms: {floor.gflop:.2f} GFLOP at {machine.product_gflops:.0f} GFLOP/s "
        f"= {floor.products_ms:.1f} ms, {floor.megabytes:.0f} MB at {machine.bandwidth_gb:.1f} GB/s "
        f"= {floor.memory_ms:.1f} ms ({floor.rows} table rows touched)"
    )
    return "\n".join(lines)


def main(config: Config) -> None:
    """Measure, print, write."""
    threads = config.threads or os.cpu_count() or 1
    torch.set_num_threads(threads)
    if config.memory_of is not None:
        job = VARIANTS[config.memory_of](SIZES[config.sizes[0]])
        for _ in range(3):
            job.step()
        print(_peak_memory_mb())
        return
    result: dict[str, object] = {**describe(), "threads": threads, "load": os.getloadavg()}
    for size in config.sizes:
        rows = measure(size, config.rounds, threads)
        machine = measure_machine()
        floor = floor_of(SIZES[size], machine)
        print(report(rows, floor, machine), flush=True)
        result[size] = {
            "milliseconds": [asdict(row) for row in rows],
            "machine": asdict(machine),
            "floor": {**asdict(floor), "total_ms": floor.total_ms},
        }
    if config.output is not None:
        config.output.parent.mkdir(parents=True, exist_ok=True)
        config.output.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
