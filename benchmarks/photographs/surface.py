"""From photographs to a mesh: the object's surface after training and export, against the truth.

    python -m benchmarks.photographs.surface [--sets frog ...] [--keep FOLDER] [--jobs 4] [--output FILE]

The captures are those of `python -m benchmarks.photographs`, and frames that it decoded are used again. Where something
stands around the object, the scan is made with `--object-only`.
"""

import json
import shutil
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float
from numpy import ndarray

from benchmarks.common.machine import write_rows
from benchmarks.common.whole_runs import run
from benchmarks.photographs.command import process
from benchmarks.photographs.sets import CaptureSet, captures_of, chosen_sets
from benchmarks.photographs.truth import read_truth
from sl_nerfstudio.cli.run import run as run_main
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.meshing.files import read_mesh

PHANTOM = 0.01  # of the object's size: farther from the truth than that, surface is invented
OBJECT_MM = 120.0  # lengths are stated for an object of this size
_SAMPLES = 100_000


@dataclass(frozen=True)
class Config:
    """Which sets are made into meshes."""

    sets: tuple[str, ...] = ("frog-none-plain", "dog-table-plain", "head-table-realistic", "frog-walls-hard")
    """parts of the names of sets"""
    frames: int = 24
    """captures of each set"""
    resolution: int = 600
    """width of the images, pixels"""
    keep: Path = Path("outputs/photographs")
    """folder of the captures"""
    scans: Path | None = None
    """folder of the scans made from them; default: scans/ in the folder of the captures"""
    jobs: int = 4
    """number of processes of sl-process"""
    output: Path | None = None
    """where to write the figures as JSON, with machine, date and commit"""


@dataclass(frozen=True)
class SurfaceFigures:
    """Errors after alignment with scale, in mm of an object of `OBJECT_MM`."""

    name: str
    rmse: float
    median: float
    completeness_rmse: float
    phantom: float  # share of the mesh's area that is farther from the truth than PHANTOM
    verdict: str  # of sl-eval
    seconds: float  # sl-process (with the frames already decoded), training, export

    def text(self) -> str:
        """A line of the table."""
        return (
            f"{self.name:42} RMSE {self.rmse:.3f} median {self.median:.3f} complete {self.completeness_rmse:.3f} mm | "
            f"phantom {self.phantom:.2%} | {self.verdict} | {self.seconds:.0f} s"
        )


def measure_surface(one: CaptureSet, config: Config) -> SurfaceFigures:
    """Process, train, export and evaluate one set. Raises UserError if sl-process makes no scan."""
    captures = captures_of(one, config.frames, config.resolution, config.keep)
    scans = config.scans or config.keep / "scans"
    scan, folder = scans / f"{captures.name}.object", scans / f"{captures.name}.run"
    for old in (scan, folder):
        shutil.rmtree(old, ignore_errors=True)
    begin = time.monotonic()
    more = ["--unordered"] if one.unordered else []
    more += [] if one.background == "none" else ["--object-only"]
    message = process(captures, scan, scans / f"{captures.name}.work", config.jobs, more)
    if message:
        raise UserError(f"{one.name}: no scan\n{message}")
    fixed = ("--output-dir", str(folder), "--experiment-name", "scan", "--timestamp", "run")
    run("ns-train", "sl-neus", "--data", str(scan), *fixed)
    trained, mesh, poses = folder / "scan/sl-neus/run/config.yml", folder / "mesh.ply", folder / "refined"
    run("sl-export", "--load-config", str(trained), "--output", str(mesh), "--poses", str(poses))
    seconds = time.monotonic() - begin
    shutil.copytree(captures / "ground_truth", scan / "ground_truth")
    result = folder / "evaluation.json"
    run("sl-eval", "--mesh", str(mesh), "--data", str(scan), "--poses", str(poses / "transforms.json"),
        "--json", str(result), "--report", str(folder / "report.html"))  # fmt: skip
    found, size = json.loads(result.read_text()), read_truth(captures, one).size
    score, mm = found["similarity"], OBJECT_MM / size
    return SurfaceFigures(
        one.name,
        score["accuracy"]["rmse"] * mm,
        score["accuracy"]["median"] * mm,
        score["completeness"]["rmse"] * mm,
        phantom_share(mesh, captures / "ground_truth/mesh.ply", np.array(score["matrix"]), PHANTOM * size),
        found["verdict"],
        seconds,
    )


def phantom_share(mesh: Path, truth: Path, S_truth_result: Float[ndarray, "4 4"], farthest: float) -> float:
    """Share of the area of `mesh` that is farther than `farthest` from the truth, in the truth's unit."""
    points, _ = IndexedMesh(read_mesh(mesh)).sample(_SAMPLES, 0)
    placed = points @ S_truth_result[:3, :3].T + S_truth_result[:3, 3]
    return float((IndexedMesh(read_mesh(truth)).distance(placed) > farthest).mean())


def main() -> None:
    """Print a line for each set, and write all to JSON."""
    config = tyro.cli(Config, description=__doc__)
    rows: list[SurfaceFigures] = []
    for one in chosen_sets(config.sets):
        rows.append(measure_surface(one, config))
        print(rows[-1].text(), flush=True)
        if config.output is not None:
            write_rows(config.output, rows, frames=config.frames, resolution=config.resolution)


if __name__ == "__main__":
    run_main(main)
