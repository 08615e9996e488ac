"""Time and memory of surface extraction, compared with dense marching cubes over the whole box.

python -m benchmarks.mesh_time [--resolutions 128 256 512 1024] [--load-config RUN/config.yml] [--output results.json]
"""

import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from torch import Tensor

from benchmarks.common.machine import write_rows
from sl_nerfstudio.cli.run import run
from sl_nerfstudio.meshing.extract import extract_mesh


@dataclass(frozen=True)
class Config:
    """Sparse extraction against dense marching cubes, on an analytic torus or on the field of a trained run."""

    resolutions: tuple[int, ...] = (128, 256, 512, 1024)
    """Cells along each side of the box."""
    dense_up_to: int = 256
    """Largest resolution at which dense marching cubes (scikit-image) are run; they need resolution^3 evaluations."""
    repeats: int = 3
    """How often sparse and dense take turns; median and range are reported."""
    load_config: Path | None = None
    """config.yml of a trained run, whose field is extracted instead of the torus."""
    output: Path | None = None
    """Where to write the figures as JSON, with machine, date and commit."""


@dataclass(frozen=True)
class Row:
    """One resolution; times in seconds: median, shortest, longest."""

    field: str
    resolution: int
    triangles: int
    evaluations: int
    total: tuple[float, float, float]
    own: tuple[float, float, float]  # excluding evaluations of the field
    dense: tuple[float, float, float] | None
    peak_gb: float  # of the process up to now


class Counted:
    """A field that counts its evaluations and their time."""

    def __init__(self, field: Callable[[Tensor], Tensor]) -> None:
        self.field, self.evaluations, self.seconds = field, 0, 0.0

    def __call__(self, p: Tensor) -> Tensor:
        """The field at points `p`."""
        start = time.perf_counter()
        value = self.field(p)
        self.seconds += time.perf_counter() - start
        self.evaluations += len(p)
        return value


def torus(p: Tensor) -> Tensor:
    """Signed distance from a torus of radii 0.55 and 0.2."""
    return torch.stack([p[:, :2].norm(dim=-1) - 0.55, p[:, 2]], -1).norm(dim=-1) - 0.2


def dense(field: Callable[[Tensor], Tensor], resolution: int, device: torch.device) -> float:
    """Seconds for evaluating the whole grid and running scikit-image's marching cubes on it."""
    from skimage.measure import marching_cubes

    start = time.perf_counter()
    axis = torch.linspace(-1, 1, resolution + 1, device=device)
    layers = []
    with torch.no_grad():
        for x in axis:
            y, z = torch.meshgrid(axis, axis, indexing="ij")
            layers.append(field(torch.stack([x.expand_as(y), y, z], -1).reshape(-1, 3)).reshape(y.shape).cpu())
    marching_cubes(torch.stack(layers).numpy(), 0.0)
    return time.perf_counter() - start


def measure(name: str, field: Callable[[Tensor], Tensor], resolution: int, device: torch.device, config: Config) -> Row:
    """Measure all repeats of one resolution."""
    totals, owns, denses, triangles, evaluations = [], [], [], 0, 0
    for _ in range(config.repeats):
        counted = Counted(field)
        start = time.perf_counter()
        mesh = extract_mesh(counted, resolution, device=device)
        totals.append(time.perf_counter() - start)
        owns.append(totals[-1] - counted.seconds)
        triangles, evaluations = len(mesh.faces), counted.evaluations
        if resolution <= config.dense_up_to:
            denses.append(dense(field, resolution, device))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e9 if sys.platform == "darwin" else 1e6)
    slow = _spread(denses) if denses else None
    return Row(name, resolution, triangles, evaluations, _spread(totals), _spread(owns), slow, peak)


def _spread(values: list[float]) -> tuple[float, float, float]:
    ordered = sorted(values)
    return ordered[len(ordered) // 2], ordered[0], ordered[-1]


def main() -> None:
    """Measure, print, write."""
    config = tyro.cli(Config)
    name, field, device = "torus", torus, torch.device("cpu")
    if config.load_config is not None:
        from sl_nerfstudio.runs.run import load_run

        model = load_run(config.load_config).model
        name, field, device = "trained field", model.sdf, model.device
    rows = []
    print("resolution triangles evaluations  share   total s (range)        own s   dense s  peak GB")
    for resolution in config.resolutions:
        row = measure(name, field, resolution, device, config)
        rows.append(row)
        slow = "" if row.dense is None else f"{row.dense[0]:.2f}"
        print(
            f"{row.resolution:10} {row.triangles:9,} {row.evaluations:11,} {row.evaluations / resolution**3:6.1%}"
            f" {row.total[0]:7.2f} ({row.total[1]:.2f} to {row.total[2]:.2f}) {row.own[0]:9.2f} {slow:>9}"
            f" {row.peak_gb:8.2f}",
            flush=True,
        )
    if config.output:
        write_rows(config.output, rows, threads=torch.get_num_threads())


if __name__ == "__main__":
    run(main)
