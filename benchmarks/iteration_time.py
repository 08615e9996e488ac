"""Time of one training step: ours, nerfstudio's torch HashEncoding with the same MLP, and the machine's lower bound.

    python -m benchmarks.iteration_time [--sizes paper lean] [--rounds 15] [--threads 2] [--output FILE]

The variants take turns, one step each, so that other load on the machine affects all of them equally. The lower bound
is what a step must compute and move: (FLOPs of the MLP) / (speed of matrix products of the MLP's shapes) + (bytes of
table rows) / (bandwidth).
- FLOPs: each layer's product once forward and twice backward (gradients of input and weights) for rendered points;
  twice that for Eikonal points (value and gradient forward; their directional derivatives, adjoints and two weight
  products backward). Activation, interpolation, rendering and losses count as free.
- Bytes: each table row that a step touches is read forward, read backward (for the gradients of the points), and its
  gradient read and written, once, however many points share it. Adam reads row, gradient and two moments, and writes
  row and moments. Caches are assumed to be perfect, and rows that are not touched cost nothing.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # spinning threads would slow down the next variant

import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from benchmarks.common.iteration_step import SIZES, VARIANTS, Ours, Size
from benchmarks.common.measuring import describe, options, peak_gb

INPUT, HIDDEN = 43, 128


@dataclass(frozen=True)
class Machine:
    """Speed of this machine, with torch's number of threads."""

    product_gflops: float  # float32 matrix products of the MLP's shapes, in 10^9 operations per second
    bandwidth_gb: float  # bytes read plus written by a copy of 256 MB, in GB per second


@dataclass(frozen=True)
class Floor:
    """Shortest possible time of a step, in milliseconds."""

    products_ms: float
    memory_ms: float
    total_ms: float
    gflop: float
    megabytes: float
    rows: int  # of the table that are touched


@dataclass(frozen=True)
class Row:
    """Milliseconds per step."""

    size: str
    variant: str
    median: float
    best: float
    quartiles: tuple[float, float]
    peak_memory_mb: float  # of a process that does nothing else, including everything it imports


def measure_machine() -> Machine:
    """Best of many short runs: the speed of the machine when it is otherwise idle."""
    n = 8192
    x, h = torch.randn(n, INPUT), torch.randn(n, HIDDEN)
    w1, w2 = torch.randn(INPUT, HIDDEN), torch.randn(HIDDEN, HIDDEN)
    out, back = torch.empty(n, HIDDEN), torch.empty(n, INPUT)
    d1, d2 = torch.empty(INPUT, HIDDEN), torch.empty(HIDDEN, HIDDEN)

    def products() -> None:
        for a, b, result in ((x, w1, out), (h, w2, out), (h, w2.T, out), (h, w1.T, back), (x.T, h, d1), (h.T, h, d2)):
            torch.mm(a, b, out=result)

    def best(function: Callable[[], object], repeats: int) -> float:
        times = []
        for _ in range(repeats):
            start = time.perf_counter()
            function()
            times.append(time.perf_counter() - start)
        return min(times)

    flop = 2 * n * HIDDEN * (INPUT * 3 + HIDDEN * 3)
    source = torch.zeros(32 * 2**20)
    target = torch.zeros_like(source)
    return Machine(flop / best(products, 60) / 1e9, 2 * source.nbytes / best(lambda: target.copy_(source), 20) / 1e9)


def floor_of(size: Size, machine: Machine) -> Floor:
    """Shortest possible time of a step of this size on this machine."""
    unit = 2 * (INPUT * HIDDEN + HIDDEN * HIDDEN + HIDDEN)
    flop = unit * (3 * size.points + 6 * size.eikonal)
    ours = Ours(size)
    points = ours.job.rays().detach().reshape(-1, 3)
    ours.field.sdf(torch.cat([points, ours.job.eikonal_points()])).sum().backward()
    table = ours.field.encoding.table
    assert table.grad is not None
    rows = int((table.grad != 0).any(1).sum())
    moved = rows * 32 * (4 + 7)
    products, memory = flop / machine.product_gflops / 1e6, moved / machine.bandwidth_gb / 1e6
    return Floor(products, memory, products + memory, flop / 1e9, moved / 1e6, rows)


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
        command = [sys.executable, "-m", "benchmarks.iteration_time", "--sizes", size, "--memory-of", name]
        done = subprocess.run([*command, "--threads", str(threads)], capture_output=True, text=True, check=True)
        peak = float(done.stdout.split()[-1])
        rows.append(Row(size, name, statistics.median(values), min(values), (low, high), peak))
    return rows


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


def main() -> None:
    """Measure, print, write; with --memory-of only print the peak memory, in MB, of three steps of a variant."""
    given = options(__doc__, sizes=SIZES, rounds=15, threads=os.cpu_count() or 1, output=Path, memory_of=str)
    torch.set_num_threads(given.threads)
    if given.memory_of is not None:
        job = VARIANTS[given.memory_of](SIZES[given.sizes[0]])
        for _ in range(3):
            job.step()
        print(1024 * peak_gb())
        return
    result: dict[str, object] = {**describe(), "threads": given.threads, "load": os.getloadavg()}
    for size in given.sizes:
        rows, machine = measure(size, given.rounds, given.threads), measure_machine()
        floor = floor_of(SIZES[size], machine)
        print(report(rows, floor, machine), flush=True)
        milliseconds = [asdict(row) for row in rows]
        result[size] = {"milliseconds": milliseconds, "machine": asdict(machine), "floor": asdict(floor)}
    if given.output is not None:
        given.output.parent.mkdir(parents=True, exist_ok=True)
        given.output.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
