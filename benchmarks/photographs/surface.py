"""From photographs to a mesh: the object's surface after training and export, against the truth.

    python -m benchmarks.photographs.surface [--sets frog ...] [--keep FOLDER] [--jobs 4] [--output FILE]

The captures are those of `python -m benchmarks.photographs`, and frames that it decoded are used again. Where something
stands around the object, the scan is made with `--object-only`.
"""

import shutil
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from benchmarks.common.measuring import Rows, options
from benchmarks.common.runs import evaluate, export, process, train
from benchmarks.photographs.scoring import read_truth
from benchmarks.photographs.sets import WORK, chosen_captures, note_of
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.meshing.files import read_mesh

PHANTOM = 0.01  # of the object's size: farther from the truth than that, surface is invented
OBJECT_MM = 120.0  # lengths are stated for an object of this size
_SAMPLES = 100_000


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


def phantom_share(mesh: Path, truth: Path, S_truth_result: Float[ndarray, "4 4"], farthest: float) -> float:
    """Share of the area of `mesh` that is farther than `farthest` from the truth, in the truth's unit."""
    points, _ = IndexedMesh(read_mesh(mesh)).sample(_SAMPLES, 0)
    placed = points @ S_truth_result[:3, :3].T + S_truth_result[:3, 3]
    return float((IndexedMesh(read_mesh(truth)).distance(placed) > farthest).mean())


def measure(captures: Path, jobs: int) -> SurfaceFigures:
    """Process, train, export and evaluate one set. Raises UserError if sl-process makes no scan."""
    scan, folder = captures / "object", captures / "run"
    for old in (scan, folder):
        shutil.rmtree(old, ignore_errors=True)
    begin = time.monotonic()
    more = ["--unordered"] * note_of(captures)["unordered"]
    more += ["--object-only"] if (captures / "ground_truth/surroundings.ply").exists() else []
    message = process(captures, scan, captures / WORK, jobs, *more)
    if message:
        raise UserError(f"{captures.name}: no scan\n{message}")
    mesh, poses = folder / "mesh.ply", folder / "refined"
    export(train(scan, folder, "run"), mesh, poses)
    seconds = time.monotonic() - begin
    shutil.copytree(captures / "ground_truth", scan / "ground_truth")
    found = evaluate(mesh, scan, poses, folder / "evaluation.json", "--report", folder / "report.html")
    score, size = found["similarity"], read_truth(captures).size
    mm, matrix, accuracy = OBJECT_MM / size, np.array(score["matrix"]), score["accuracy"]
    return SurfaceFigures(
        captures.name, accuracy["rmse"] * mm, accuracy["median"] * mm, score["completeness"]["rmse"] * mm,
        phantom_share(mesh, captures / "ground_truth/mesh.ply", matrix, PHANTOM * size), found["verdict"], seconds,
    )  # fmt: skip


def main() -> None:
    """Print a line for each set, and write all to JSON."""
    given = options(
        __doc__, sets=["frog-none-plain", "dog-table-plain", "head-table-realistic", "frog-walls-hard"], frames=24,
        resolution=600, keep=Path("outputs/photographs"), jobs=4, output=Path,
    )  # fmt: skip
    rows: Rows[SurfaceFigures] = Rows(given.output, frames=given.frames, resolution=given.resolution)
    for captures in chosen_captures(given.sets, given.frames, given.resolution, given.keep):
        rows.add(measure(captures, given.jobs))


if __name__ == "__main__":
    main()
