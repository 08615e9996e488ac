"""Classical fusion: Open3D's TSDF with initial, ICP-registered, our refined, and true poses, on scans with known truth.

python -m benchmarks.tsdf_baseline SCAN [SCAN ...] [--poses refined] [--output results.json]

Fusion with our refined poses, those with which `sl-neus` trains, tells what the field adds to the poses.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from benchmarks.baselines.icp_registration import register
from benchmarks.baselines.refined_poses import refined_poses
from benchmarks.baselines.tsdf import fuse
from benchmarks.common.machine import write_rows
from sl_nerfstudio.cli.run import run
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.evaluation.evaluate import SurfaceScore, score_alignments
from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.evaluation.reference import compare_poses, mesh_reference
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.meshing.files import read_mesh, write_mesh
from sl_nerfstudio.scan import Scan, read_ground_truth, read_scan

PoseKind = Literal["initial", "registered", "refined", "true"]
POSES: dict[PoseKind, Callable[[Scan, DevicePoses], DevicePoses]] = {
    "initial": lambda scan, true: scan.poses,
    "registered": lambda scan, true: register(scan, scan.poses),
    "refined": lambda scan, true: refined_poses(scan),
    "true": lambda scan, true: true,
}


@dataclass(frozen=True)
class Config:
    """TSDF fusion with several kinds of poses."""

    scans: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Scan folders with ground_truth/."""
    poses: tuple[PoseKind, ...] = ("initial", "registered", "refined", "true")
    """With which poses: the scan's, after ICP, after our joint adjustment, true."""
    output: Path | None = None
    """Where to write the figures as JSON, with machine, date and commit."""
    meshes: Path | None = None
    """Folder for the fused meshes, SCAN-POSES.ply."""


@dataclass(frozen=True)
class Row:
    """One fusion; lengths in the scan's unit, after rigid ICP."""

    scan: str
    poses: str
    units: str
    seconds: float
    accuracy_rmse: float
    accuracy_median: float
    completeness_rmse: float
    completeness_median: float
    accuracy_rmse_similarity: float
    scale: float
    camera_translation_rmse: float
    camera_rotation_rmse_deg: float


def measure(root: Path, kinds: tuple[PoseKind, ...], meshes: Path | None) -> list[Row]:
    """Fuse one scan with each kind of poses. Raises UserError for a scan without truth."""
    scan = read_scan(root)
    truth = read_ground_truth(scan)
    if truth.mesh_path is None or truth.poses is None:
        raise UserError(f"{root}: has no complete ground_truth/\n    remedy: make one with sl-synth")
    true = truth.poses
    reference = mesh_reference(read_mesh(truth.mesh_path), scan, true)
    rows = []
    for name in kinds:
        start = time.perf_counter()
        poses = POSES[name](scan, true)
        mesh = fuse(scan, poses)
        seconds = time.perf_counter() - start
        if meshes is not None:
            write_mesh(meshes / f"{root.name}-{name}.ply", mesh)
        scores = score_alignments(IndexedMesh(mesh), reference, poses, true)
        errors = compare_poses(poses, true)
        rows.append(_row(root.name, name, scan.units, seconds, scores["rigid"], scores["similarity"], errors.camera))
    return rows


def _row(scan, poses, units, seconds, rigid: SurfaceScore, similarity: SurfaceScore, camera) -> Row:
    return Row(
        scan=scan,
        poses=poses,
        units=units,
        seconds=seconds,
        accuracy_rmse=rigid.accuracy.rmse,
        accuracy_median=rigid.accuracy.median,
        completeness_rmse=rigid.completeness.rmse,
        completeness_median=rigid.completeness.median,
        accuracy_rmse_similarity=similarity.accuracy.rmse,
        scale=similarity.scale,
        camera_translation_rmse=camera.translation_rmse,
        camera_rotation_rmse_deg=camera.rotation_rmse_deg,
    )


def main() -> None:
    """Measure, print, write."""
    config = tyro.cli(Config)
    rows: list[Row] = []
    print("scan                 poses       accuracy RMS   median completeness RMS   median with scale      s")
    for root in config.scans:
        for row in measure(root, config.poses, config.meshes):
            rows.append(row)
            print(
                f"{row.scan:20} {row.poses:11} {row.accuracy_rmse:9.3f} {row.units:2} {row.accuracy_median:8.3f} "
                f"{row.completeness_rmse:16.3f} {row.completeness_median:8.3f} {row.accuracy_rmse_similarity:10.3f} "
                f"{row.seconds:6.1f}",
                flush=True,
            )
    if config.output:
        write_rows(config.output, rows)


if __name__ == "__main__":
    run(main)
