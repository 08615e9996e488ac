"""The files that sl-eval reads and writes besides scan and mesh."""

import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from sl_nerfstudio.evaluation.evaluate import Poses, mesh_reference
from sl_nerfstudio.evaluation.reference import PointReference, Reference
from sl_nerfstudio.meshing.mesh_io import read_mesh
from sl_nerfstudio.scan import FileError, PoseSigma, Scan, read_poses
from sl_nerfstudio.scan.document import read_document
from sl_nerfstudio.scan.file_error import check_file

_SIGMA_KEYS = tuple(PoseSigma.__dataclass_fields__)


def read_poses_file(path: Path, scan: Scan) -> Poses:
    """Poses of a transforms.json that belong to `scan`. Raises UserError if they are of another scan or unit."""
    document = read_document(path)
    units, frames = document.get("units"), document.get("frames")
    if units != scan.units:
        raise FileError(
            path, f"units: {units!r}, but the scan's are {scan.units!r}", "the poses belong to another scan",
            "give poses that were refined from this scan",
        )  # fmt: skip
    if isinstance(frames, list) and len(frames) != len(scan.frames):
        raise FileError(
            path, f"holds {len(frames)} frames, the scan {len(scan.frames)}", "the poses belong to another scan",
            "give poses that were refined from this scan",
        )  # fmt: skip
    cameras, projectors = read_poses(path, scan)
    if cameras is None or projectors is None:
        missing = "transform_matrix" if cameras is None else "projector_transform_matrix"
        raise FileError(
            path, f"has no {missing}", "not the transforms.json of a scan", "give one with both poses per frame"
        )
    return Poses(cameras, projectors)


def read_sigmas(path: Path, scan: Scan) -> list[PoseSigma | None]:
    """Posterior uncertainty of each frame (`sl_pose_sigma`), None where it is not stated."""
    found: dict[str, PoseSigma] = {}
    for record in read_document(path)["frames"]:
        sigma = record.get("sl_pose_sigma")
        if isinstance(sigma, dict) and all(isinstance(sigma.get(key), int | float) for key in _SIGMA_KEYS):
            found[Path(record["file_path"]).stem] = PoseSigma(**{key: float(sigma[key]) for key in _SIGMA_KEYS})
    return [found.get(frame.name) for frame in scan.frames]


def read_training(path: Path) -> dict[str, Any] | None:
    """Settings, versions and curves of the run; None if the file does not exist."""
    return read_document(path) if path.exists() else None


def read_reference(path: Path | None, scan: Scan, poses: Poses, samples: int, seed: int) -> Reference | None:
    """The true mesh or reference points; None without a path. `poses` tell what the scan could observe."""
    if path is None:
        return None
    if path.suffix.lower() == ".npz":
        points = read_points(path)
        return PointReference(
            points, f"{len(points):,} reference points ({path.name}); accuracy cannot fall below their spacing, and "
            "completeness counts all of them",
        )  # fmt: skip
    return mesh_reference(read_mesh(path), scan, poses, samples, seed)


def read_points(path: Path) -> np.ndarray:
    """Points (n, 3) under the key `xyz` of an .npz file, never unpickled. Raises UserError."""
    check_file(path)
    try:
        with np.load(path, allow_pickle=False) as archive:
            if "xyz" not in archive:
                raise FileError(
                    path, f"has no key xyz (it has {', '.join(archive.files) or 'none'})", "another kind of .npz file",
                    "save the points as numpy.savez(path, xyz=points), points (n, 3)",
                )  # fmt: skip
            points = archive["xyz"]
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        raise FileError(
            path, f"cannot be read ({error})", "it is broken or no .npz file", "save the points again"
        ) from error
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 100 or not np.issubdtype(points.dtype, np.number):
        raise FileError(
            path,
            f"xyz: is {points.dtype} {points.shape}",
            "not a list of points",
            "give at least 100 points as (n, 3) numbers",
        )
    if not np.isfinite(points).all():
        bad = int((~np.isfinite(points)).any(1).sum())
        raise FileError(path, f"xyz: {bad} points are not numbers", "failed triangulations", "leave those points out")
    return points.astype(np.float64)
