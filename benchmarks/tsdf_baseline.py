"""Classical fusion: Open3D's TSDF with initial, ICP-registered, our refined, and true poses, on scans with known truth.

    python -m benchmarks.tsdf_baseline SCAN [SCAN ...] [--poses refined] [--output results.json]

Fusion with our refined poses, those with which `sl-neus` trains, tells what the field adds to the poses. `tracked` is
fusion frame to model, as KinectFusion does it: frames are tracked against what was fused before them.
"""

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.baselines.frame_to_model import fuse_frame_to_model
from benchmarks.baselines.poses import refined_poses, register
from benchmarks.baselines.tsdf import fuse
from benchmarks.common.measuring import Rows
from sl_nerfstudio.cli.run import run
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.evaluation.evaluate import score_alignments
from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.evaluation.reference import compare_poses, mesh_reference
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.meshing.files import read_mesh
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.scan import Scan, read_ground_truth, read_scan

Fused = tuple[Mesh, DevicePoses]


def _with(poses: Callable[[Scan, DevicePoses], DevicePoses]) -> Callable[[Scan, DevicePoses], Fused]:
    """Fusion with these poses, which are found first."""

    def fused(scan: Scan, true: DevicePoses) -> Fused:
        found = poses(scan, true)
        return fuse(scan, found), found

    return fused


POSES: dict[str, Callable[[Scan, DevicePoses], Fused]] = {
    "initial": _with(lambda scan, true: scan.poses),
    "tracked": lambda scan, true: fuse_frame_to_model(scan, scan.poses),
    "registered": _with(lambda scan, true: register(scan, scan.poses)),
    "refined": _with(lambda scan, true: refined_poses(scan)),
    "true": _with(lambda scan, true: true),
}


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


def measure(root: Path, kinds: Sequence[str]) -> Iterator[Row]:
    """Fuse one scan with each kind of poses. Raises UserError for a scan without truth."""
    scan = read_scan(root)
    truth = read_ground_truth(scan)
    if truth.mesh_path is None or truth.poses is None:
        raise UserError(f"{root}: has no complete ground_truth/\n    remedy: make one with sl-synth")
    reference = mesh_reference(read_mesh(truth.mesh_path), scan, truth.poses)
    for name in kinds:
        start = time.perf_counter()
        mesh, poses = POSES[name](scan, truth.poses)
        seconds = time.perf_counter() - start
        scores = score_alignments(IndexedMesh(mesh), reference, poses, truth.poses)
        camera, rigid, similarity = compare_poses(poses, truth.poses).camera, scores["rigid"], scores["similarity"]
        yield Row(
            root.name, name, scan.units, seconds, rigid.accuracy.rmse, rigid.accuracy.median, rigid.completeness.rmse,
            rigid.completeness.median, similarity.accuracy.rmse, similarity.scale, camera.translation_rmse,
            camera.rotation_rmse_deg,
        )  # fmt: skip


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scans", nargs="+", type=Path, help="scan folders with ground_truth/")
    parser.add_argument("--poses", nargs="+", default=list(POSES), choices=POSES)
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    rows: Rows[Row] = Rows(given.output)
    for root in given.scans:
        for row in measure(root, given.poses):
            rows.add(row)


if __name__ == "__main__":
    run(main)
