"""What a method hands in for one scan, and its figures."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from benchmarks.open.scans import OpenScan
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.evaluation.evaluate import score_alignments
from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.evaluation.reference import MeshReference, compare_poses, mesh_reference
from sl_nerfstudio.geometry.devices import Y_Z_DOWN
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.meshing.files import read_mesh
from sl_nerfstudio.scan import Scan, read_ground_truth, read_scan
from sl_nerfstudio.scan.document import TRANSFORMS, frame_label, read_document

CAMERAS_TUM, PROJECTORS_TUM = "cameras.txt", "projectors.txt"
_ORTHOGONAL = 1e-3  # largest departure of R R^T from the identity


@dataclass(frozen=True)
class HandedPoses:
    """Device-to-world poses by the frame's name, in the axes of the scan format; projectors may be missing."""

    camera: dict[str, Float64[ndarray, "4 4"]]
    projector: dict[str, Float64[ndarray, "4 4"]]


def read_handed_poses(folder: Path) -> HandedPoses | None:
    """The poses in a folder; None if it has neither file. Raises UserError for files that cannot be right."""
    if (folder / TRANSFORMS).exists():
        return _of_transforms(folder / TRANSFORMS)
    if (folder / CAMERAS_TUM).exists():
        path = folder / PROJECTORS_TUM
        return HandedPoses(_of_tum(folder / CAMERAS_TUM), _of_tum(path) if path.exists() else {})
    return None


def _of_transforms(path: Path) -> HandedPoses:
    document = read_document(path)
    frames = document.get("frames")
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise UserError(f"{path}: frames: is missing or is not a list of objects")
    found: list[dict[str, Float64[ndarray, "4 4"]]] = []
    for key in ("transform_matrix", "projector_transform_matrix"):
        labels = [(frame_label(frame, k), frame) for k, frame in enumerate(frames)]
        found.append({name: _pose(path, name, frame[key]) for name, frame in labels if frame.get(key) is not None})
    return HandedPoses(*found)


def _of_tum(path: Path) -> dict[str, Float64[ndarray, "4 4"]]:
    found = {}
    for number, line in enumerate(path.read_text().splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            tx, ty, tz, qx, qy, qz, qw = map(float, words[1:])
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = Rotation.from_quat([qx, qy, qz, qw]).as_matrix(), (tx, ty, tz)
        except ValueError as error:
            raise UserError(
                f"{path}: line {number}: is not NAME TX TY TZ QX QY QZ QW\n"
                "    remedy: one line for each frame: its name, the position, and a quaternion other than 0"
            ) from error
        found[words[0]] = T @ Y_Z_DOWN
    return found


def _pose(path: Path, name: str, value: object) -> Float64[ndarray, "4 4"]:
    try:
        T = np.array(value, dtype=np.float64)
        R = T[:3, :3]
        right = T.shape == (4, 4) and bool(np.abs(R @ R.T - np.eye(3)).max() < _ORTHOGONAL)
    except (ValueError, TypeError, IndexError):
        right = False
    if not right:
        raise UserError(f"{path}: {name}: is not a 4 x 4 pose\n    remedy: give rotation and translation, unscaled")
    return T


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
        scan=scan.name, accuracy_rmse=found.accuracy.rmse, accuracy_median=found.accuracy.median,
        completeness_mean=found.completeness.mean, completeness_median=found.completeness.median,
        f_score=found.f_score[distance], scale=scaled.scale, frames=len(index), all_frames=len(names),
        camera_mm=None if errors is None else errors.camera.translation_rmse,
        camera_deg=None if errors is None else errors.camera.rotation_rmse_deg,
        projector_deg=None if errors is None or not both else errors.projector.rotation_rmse_deg,
    )  # fmt: skip


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
