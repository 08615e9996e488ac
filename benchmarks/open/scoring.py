"""The figures of one result on one scan of the benchmark."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.open.results import HandedPoses, read_handed_poses
from benchmarks.open.scans import OpenScan
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.evaluation.evaluate import score_alignments
from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.evaluation.reference import MeshReference, compare_poses, mesh_reference
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.meshing.files import read_mesh
from sl_nerfstudio.scan import Scan, read_ground_truth, read_scan

F_SHARE = 0.002  # of the truth's diagonal: the distance of the F-score
_FEWEST_FRAMES = 2
_SAMPLES = 50_000


@dataclass(frozen=True)
class Truth:
    """What a result is compared with; frames that show nothing do not count."""

    scan: Scan
    poses: DevicePoses
    reference: MeshReference


@dataclass(frozen=True)
class ScanFigures:
    """Lengths in mm. Rigid alignment; with scale for photographs, which show no length."""

    scan: str
    accuracy_rmse: float  # result to truth
    accuracy_median: float
    completeness_mean: float  # truth, as far as it could be observed, to result
    completeness_median: float
    f_score: float  # at F_SHARE of the diagonal
    scale: float  # factor that a free scale would apply
    frames: int  # with a pose
    all_frames: int
    camera_mm: float | None  # RMS after one similarity of all devices; None without poses
    camera_deg: float | None
    projector_deg: float | None


def read_truth(scan: OpenScan, data: Path) -> Truth:
    """The truth of a scan that `make` made. Raises UserError if it is not there."""
    root = data / scan.name
    if not root.exists():
        raise UserError(f"{root}: is not there\n    remedy: python -m benchmarks.open make --output {data}")
    if scan.photographs:
        found = read_scan(root / "ground_truth")
        recorded = json.loads((root / "ground_truth/captures.json").read_text())["frames"]
        usable = [k for k, frame in enumerate(recorded) if frame["usable"]]
        found = replace(found, frames=tuple(found.frames[k] for k in usable))
        poses, mesh = found.poses, root / "ground_truth/mesh.ply"
    else:
        found = read_scan(root)
        truth = read_ground_truth(found)
        assert truth.poses is not None and truth.mesh_path is not None
        poses, mesh = truth.poses, truth.mesh_path
    return Truth(found, poses, mesh_reference(read_mesh(mesh), found, poses, _SAMPLES))


def score(scan: OpenScan, data: Path, folder: Path) -> ScanFigures:
    """The figures of the result in `folder`. Raises UserError for files that cannot be right."""
    truth = read_truth(scan, data)
    handed = read_handed_poses(folder)
    names = [frame.name for frame in truth.scan.frames]
    index = [] if handed is None else [k for k, name in enumerate(names) if name in handed.camera]
    if handed is not None and len(index) < _FEWEST_FRAMES:
        raise UserError(
            f"{folder}: poses of {len(index)} of the frames {names[0]} to {names[-1]}; at least {_FEWEST_FRAMES} are "
            "needed\n    remedy: name the frames as the scan does"
        )
    estimated = None if handed is None else _in_order(handed, [names[k] for k in index])
    true = None if estimated is None else _like(estimated, truth.poses[index])
    surface = IndexedMesh(read_mesh(folder / "mesh.ply"))
    distance = F_SHARE * truth.reference.size
    scores = score_alignments(surface, truth.reference, estimated, true, [distance], _SAMPLES)
    found, scaled = scores["similarity" if scan.photographs else "rigid"], scores["similarity"]
    errors = None if estimated is None or true is None else compare_poses(estimated, true)
    both = handed is not None and bool(handed.projector)
    return ScanFigures(
        scan=scan.name,
        accuracy_rmse=found.accuracy.rmse,
        accuracy_median=found.accuracy.median,
        completeness_mean=found.completeness.mean,
        completeness_median=found.completeness.median,
        f_score=found.f_score[distance],
        scale=scaled.scale,
        frames=len(index),
        all_frames=len(names),
        camera_mm=None if errors is None else errors.camera.translation_rmse,
        camera_deg=None if errors is None else errors.camera.rotation_rmse_deg,
        projector_deg=None if errors is None or not both else errors.projector.rotation_rmse_deg,
    )


def _in_order(handed: HandedPoses, names: list[str]) -> DevicePoses:
    """The poses of some frames; without projectors the cameras stand for both."""
    cameras = np.stack([handed.camera[name] for name in names])
    if not handed.projector:
        return DevicePoses(cameras, cameras.copy())
    lost = [name for name in names if name not in handed.projector]
    if lost:
        raise UserError(f"{lost[0]}: has a camera pose and no projector pose\n    remedy: give both, or no projector")
    return DevicePoses(cameras, np.stack([handed.projector[name] for name in names]))


def _like(estimated: DevicePoses, true: DevicePoses) -> DevicePoses:
    """The truth of the same devices: cameras twice where no projectors were handed in."""
    alone = np.array_equal(estimated.T_world_camera, estimated.T_world_projector)
    return DevicePoses(true.T_world_camera, true.T_world_camera.copy()) if alone else true
