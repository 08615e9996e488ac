"""Lower bound for the time of a training step on a machine, from what it must compute and what it must move.

Time = (FLOPs of the MLP) / (speed of matrix products of the MLP's shapes) + (bytes of table rows) / (bandwidth).
- FLOPs: each layer's product once forward and twice backward (gradients of input and weights) for rendered points;
  twice that for Eikonal points (value and gradient forward; their directional derivatives, adjoints and two weight
  products backward). Activation, interpolation, rendering and losses count as free.
- Bytes: each table row that a step touches is read forward, read backward (for the gradients of the points), and its
  gradient read and written, once, however many points share it. Adam reads row, gradient and two moments, and writes
  row and moments. Caches are assumed to be perfect, and rows that are not touched cost nothing.
"""

import time
from dataclasses import dataclass

import torch

from benchmarks.common.iteration_step import Ours, Size

INPUT, HIDDEN = 43, 128


@dataclass(frozen=True)
class Machine:
    """Speed of this machine, with torch's number of threads."""

    product_gflops: float
    """float32 matrix products of the MLP's shapes, in 10^9 operations per second."""
    bandwidth_gb: float
    """Bytes read plus written by a copy of 256 MB, in GB per second."""


@dataclass(frozen=True)
class Floor:
    """Shortest possible time of a step, in milliseconds."""

    products_ms: float
    memory_ms: float
    gflop: float
    megabytes: float
    rows: int
    """Number of table rows touched."""

    @property
    def total_ms(self) -> float:
        """Sum of both."""
        return self.products_ms + self.memory_ms


def measure_machine() -> Machine:
    """Best of many short runs: the speed of the machine when it is otherwise idle."""
    n = 8192
    x, h = torch.randn(n, INPUT), torch.randn(n, HIDDEN)
    w1, w2 = torch.randn(INPUT, HIDDEN), torch.randn(HIDDEN, HIDDEN)
    out, back = torch.empty(n, HIDDEN), torch.empty(n, INPUT)
    d1, d2 = torch.empty(INPUT, HIDDEN), torch.empty(HIDDEN, HIDDEN)

    def products() -> None:
        torch.mm(x, w1, out=out)
        torch.mm(h, w2, out=out)
        torch.mm(h, w2.T, out=out)
        torch.mm(h, w1.T, out=back)
        torch.mm(x.T, h, out=d1)
        torch.mm(h.T, h, out=d2)

    flop = 2 * n * HIDDEN * (INPUT * 3 + HIDDEN * 3)
    source = torch.zeros(32 * 2**20)
    target = torch.zeros_like(source)
    return Machine(
        product_gflops=flop / _best(products, 60) / 1e9,
        bandwidth_gb=2 * source.nbytes / _best(lambda: target.copy_(source), 20) / 1e9,
    )


def _best(function: object, repeats: int) -> float:
    assert callable(function)
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def floor_of(size: Size, machine: Machine) -> Floor:
    """Shortest possible time of a step of this size on this machine."""
    unit = 2 * (INPUT * HIDDEN + HIDDEN * HIDDEN + HIDDEN)
    flop = unit * (3 * size.points + 6 * size.eikonal)
    rows = _touched_rows(size)
    moved = rows * 32 * (4 + 7)
    return Floor(
        products_ms=flop / machine.product_gflops / 1e6,
        memory_ms=moved / machine.bandwidth_gb / 1e6,
        gflop=flop / 1e9,
        megabytes=moved / 1e6,
        rows=rows,
    )


def _touched_rows(size: Size) -> int:
    """Number of table rows with a gradient after the backward pass of one step."""
    ours = Ours(size)
    points = ours.job.rays().detach().reshape(-1, 3)
    ours.field.sdf(torch.cat([points, ours.job.eikonal_points()])).sum().backward()
    table = ours.field.encoding.table
    assert table.grad is not None
    return int((table.grad != 0).any(1).sum())
