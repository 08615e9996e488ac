"""The files that an evaluation reads: mesh, scan, poses, truth or reference, and what is known about the training."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.bundle_adjustment.joint_covariance.covariance import JointCovariance
from sl_nerfstudio.evaluation.reference import PointReference, Reference, mesh_reference
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.mesh_io import read_mesh
from sl_nerfstudio.meshing.ply import read_quality
from sl_nerfstudio.meshing.vertex_quality import VertexQuality
from sl_nerfstudio.runs.covariance_file import read_covariance
from sl_nerfstudio.scan import (
    FileError,
    PoseSigma,
    Scan,
    read_devices,
    read_ground_truth,
    read_pose_sigmas,
    read_poses,
    read_scan,
    read_unplaced,
)
from sl_nerfstudio.scan.coordinates import ARRAY_DAMAGE
from sl_nerfstudio.scan.document import TRANSFORMS, read_document
from sl_nerfstudio.scan.file_error import check_file
from sl_nerfstudio.verdict.departed_frames import DepartedFrame, departed_frames

_FEWEST_POINTS = 100


@dataclass(frozen=True)
class EvaluationInputs:
    """A result and what it is evaluated on; lengths in the scan's unit."""

    mesh: Mesh
    scan: Scan  # with the intrinsics of the poses file, if it has any
    poses: DevicePoses  # to evaluate
    true_poses: DevicePoses | None
    reference: Reference | None
    poses_path: Path | None  # None: the scan's own poses are evaluated
    pose_sigma: list[PoseSigma | None] = field(default_factory=list)  # one per frame, or empty
    unplaced: list[str] = field(default_factory=list)  # frames that the poses file says do not agree with the others
    training: dict[str, Any] | None = None  # training.json next to the poses: settings, versions, curves
    quality: VertexQuality | None = None  # of the mesh's vertices, if its file says
    joint: JointCovariance | None = None  # of the evaluated poses, if it is known
    true_units: str | None = None  # of the truth that is compared with, where its files say

    @property
    def stated_sigma(self) -> list[PoseSigma | None]:
        """Stated uncertainty of the evaluated poses, where those are the scan's rough starting poses; else none.

        Refined poses count as exact, so that their errors show.
        """
        return [None if self.poses_path is not None else frame.pose_sigma for frame in self.scan.frames]

    @property
    def departed(self) -> list[DepartedFrame]:
        """Frames that ended far from their starting poses; none where those are evaluated."""
        return [] if self.poses_path is None else departed_frames(self.scan, self.poses)


def read_inputs(
    mesh: Path, data: Path, poses: Path | None, reference: Path | None, samples: int, seed: int
) -> EvaluationInputs:
    """Read everything. `poses` is a transforms.json or its folder; `reference` replaces the mesh in ground_truth/.

    `samples` points with `seed` are spread over a true mesh. Raises UserError for anything missing or faulty.
    """
    scan = read_scan(data)
    result = read_mesh(mesh, scan.units)
    truth = read_ground_truth(scan)
    path = poses / TRANSFORMS if poses and poses.is_dir() else poses
    evaluated = scan.poses if path is None else read_refined_poses(path, scan)
    scan = scan if path is None else read_devices(path, scan)
    return EvaluationInputs(
        mesh=result,
        scan=scan,
        poses=evaluated,
        true_poses=truth.poses,
        true_units=truth.units if reference is None else None,
        reference=read_reference(reference or truth.mesh_path, scan, truth.poses or evaluated, samples, seed),
        poses_path=path,
        pose_sigma=[] if path is None else read_pose_sigmas(path, scan),
        unplaced=[] if path is None else read_unplaced(path, scan),
        training=None if path is None else _read_training(path.with_name("training.json")),
        quality=_read_quality(mesh, result),
        joint=None if path is None else read_covariance(path.parent, scan),
    )


def _read_quality(path: Path, mesh: Mesh) -> VertexQuality | None:
    quality = read_quality(path)
    return quality if quality is not None and len(quality.sigma) == len(mesh.vertices) else None


def read_refined_poses(path: Path, scan: Scan) -> DevicePoses:
    """Poses of a transforms.json made from `scan`. Raises UserError if they are those of another scan or unit."""
    document = read_document(path)
    units, frames = document.get("units"), document.get("frames")
    if units != scan.units:
        raise _of_another_scan(path, f"units: {units!r}, but the scan's are {scan.units!r}")
    if isinstance(frames, list) and len(frames) != len(scan.frames):
        raise _of_another_scan(path, f"holds {len(frames)} frames, the scan {len(scan.frames)}")
    return read_poses(path, scan)


def _of_another_scan(path: Path, problem: str) -> FileError:
    return FileError(
        path, problem, "the poses are those of another scan", "give poses that were refined from this scan"
    )


def _read_training(path: Path) -> dict[str, Any] | None:
    return read_document(path) if path.exists() else None


def read_reference(path: Path | None, scan: Scan, poses: DevicePoses, samples: int, seed: int) -> Reference | None:
    """The true mesh or reference points; None without a path. `poses` decide what the scan could observe."""
    if path is None:
        return None
    if path.suffix.lower() == ".npz":
        points = read_points(path)
        return PointReference(
            points, f"{len(points):,} reference points ({path.name}); accuracy cannot fall below their spacing, and "
            "completeness counts all of them",
        )  # fmt: skip
    return mesh_reference(read_mesh(path, scan.units), scan, poses, samples, seed)


def read_points(path: Path) -> Float64[ndarray, "n 3"]:
    """Points under the key `xyz` of an .npz file, never unpickled. Raises FileError."""
    check_file(path)
    try:
        with path.open("rb") as stream:
            archive = np.load(stream, allow_pickle=False)
            if isinstance(archive, np.ndarray):
                raise ValueError("it is a plain array")
            if "xyz" not in archive:
                raise FileError(
                    path,
                    f"has no key xyz (it has {', '.join(archive.files) or 'none'})",
                    "it is another kind of .npz file",
                    "save the points as numpy.savez(path, xyz=points), points (n, 3)",
                )
            points = archive["xyz"]
    except (*ARRAY_DAMAGE, MemoryError) as error:
        raise FileError(
            path, f"cannot be read ({error})", "it is damaged or not an .npz file", "save the points again"
        ) from error
    right = points.ndim == 2 and points.shape[1] == 3 and len(points) >= _FEWEST_POINTS
    if not right or not np.issubdtype(points.dtype, np.number):
        raise FileError(
            path,
            f"xyz: is {points.dtype} {points.shape}",
            "it is not a list of points",
            f"give at least {_FEWEST_POINTS} points as (n, 3) numbers",
        )
    if not np.isfinite(points).all():
        bad = int((~np.isfinite(points)).any(1).sum())
        raise FileError(path, f"xyz: {bad} points are not numbers", "failed triangulations", "leave those points out")
    return points.astype(np.float64)
