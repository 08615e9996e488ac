"""Other poses and devices for the frames of a scan: true ones read, refined ones written, as a transforms.json."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float64
from numpy import ndarray

from sl_nerfstudio.errors import Fault, ScanError
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.scan.atomic import write_atomic
from sl_nerfstudio.scan.document import Record, document_faults, frame_label, read_document
from sl_nerfstudio.scan.fields import Fields
from sl_nerfstudio.scan.file_error import FileError
from sl_nerfstudio.scan.partial_scan import POSES, TRANSFORMS, document_devices, read_pose
from sl_nerfstudio.scan.problem import Faults, Problem
from sl_nerfstudio.scan.types import GroundTruth, Scan
from sl_nerfstudio.scan.writing import encode_json, pose_fields

GROUND_TRUTH = "ground_truth"
_FOCAL_AND_CENTRE = ("fl_x", "fl_y", "cx", "cy")

Poses = Float64[ndarray, "n 4 4"]


def write_transforms(
    path: Path,
    scan: Scan,
    T_world_camera: Float[ndarray, "n 4 4"],
    T_world_projector: Float[ndarray, "m 4 4"],
    extra_frame_fields: Sequence[dict[str, Any]] | None = None,
    extra_fields: dict[str, Any] | None = None,
) -> None:
    """Write a copy of the scan's transforms.json with other poses, and intrinsics where those were changed; atomic.

    Everything else is kept, unknown keys too, except `sl_pose_sigma`, which spoke of the poses replaced here. Paths are
    kept as they are, relative to the scan folder: the copy is used by putting it there in place of the original.
    `extra_frame_fields` (one per frame, in the scan's order) and `extra_fields` add or replace keys. Raises ValueError
    for poses that are no rigid motions or not one per frame, ScanError if the scan's file was changed meanwhile.
    """
    extras = [{}] * len(scan.frames) if extra_frame_fields is None else extra_frame_fields
    if not len(T_world_camera) == len(T_world_projector) == len(extras) == len(scan.frames):
        raise ValueError(
            f"{len(scan.frames)} frames, but {len(T_world_camera)} camera poses, "
            f"{len(T_world_projector)} projector poses, {len(extras)} sets of fields"
        )
    document = _read(scan.root / TRANSFORMS, str(scan.root))
    names = [frame_label(record, index) for index, record in enumerate(document["frames"])]
    if names != [frame.name for frame in scan.frames]:
        raise ScanError([_changed()], str(scan.root))
    document.pop("sl_pose_sigma", None)
    for index, record in enumerate(document["frames"]):
        record.pop("sl_pose_sigma", None)
        record.update(pose_fields(T_world_camera[index], T_world_projector[index]))
        record.update(extras[index])
    if scan.intrinsics_change:
        _put_devices(document, scan)
    write_atomic(path, encode_json({**document, **(extra_fields or {})}))


def _put_devices(document: Record, scan: Scan) -> None:
    """The scan's focal lengths and principal points: of cameras that are all alike at the top, else in every frame."""
    alike = len({frame.camera for frame in scan.frames}) == 1
    _replace(document["projector"], scan.projector)
    _replace(document, scan.frames[0].camera if alike else None)
    for record, frame in zip(document["frames"], scan.frames, strict=True):
        _replace(record, None if alike else frame.camera)


def _replace(record: Record, device: Device | None) -> None:
    for key in _FOCAL_AND_CENTRE:
        record.pop(key, None)
        if device is not None:
            record[key] = getattr(device, key)


def read_devices(path: Path, scan: Scan) -> Scan:
    """The scan with the intrinsics of another transforms.json, such as a refined one; its own where that has none.

    Frames are matched by name. Raises ScanError for a device whose numbers cannot be true.
    """
    document = _read(path, str(path.parent))
    faults = Faults()
    projector, cameras = document_devices(document, path.name, faults)
    if faults.found:
        raise ScanError(faults.found, str(path.parent))
    frames = tuple(replace(frame, camera=cameras.get(frame.name, frame.camera)) for frame in scan.frames)
    return replace(scan, projector=projector or scan.projector, frames=frames)


def read_poses(path: Path, scan: Scan) -> tuple[Poses | None, Poses | None]:
    """Camera and projector poses in a transforms.json, in the order of the scan's frames.

    Frames are matched by name (the stem of `file_path`); frames that the scan lacks are passed over. A kind of pose
    that no frame has is None. Raises ScanError if a frame of the scan is missing, or a pose is faulty or missing in
    some frames only.
    """
    document = _read(path, str(path.parent))
    faults = Faults()
    document_faults(document, path.name, faults)
    records = {frame_label(record, index): record for index, record in enumerate(document["frames"])}
    present = {key: any(key in record for record in records.values()) for key in POSES}
    found: dict[str, list[Float64[ndarray, "4 4"] | None]] = {key: [] for key in POSES}
    for frame in scan.frames:
        if frame.name not in records:
            problem = Problem(
                "is missing",
                "these poses belong to another scan, or its frames were renamed",
                "give poses of every frame",
            )
            faults.add(problem, path.name, frame.name, "frames")
            continue
        fields = Fields(records[frame.name], faults, path.name, frame.name)
        for key in POSES:
            if present[key]:
                found[key].append(read_pose(fields, key))
    if faults.found:
        raise ScanError(faults.found, str(path.parent))
    return _stack(found[POSES[0]]), _stack(found[POSES[1]])


def read_ground_truth(scan: Scan) -> GroundTruth:
    """What the scan's ground_truth/ holds: mesh.ply and the poses of transforms.json, each None if absent."""
    folder = scan.root / GROUND_TRUTH
    mesh, transforms = folder / "mesh.ply", folder / TRANSFORMS
    cameras, projectors = read_poses(transforms, scan) if transforms.exists() else (None, None)
    return GroundTruth(mesh if mesh.exists() else None, cameras, projectors)


def _read(path: Path, where: str) -> Record:
    faults = Faults()
    try:
        document = read_document(path)
    except FileError as error:
        faults.add(error, path.name)
        raise ScanError(faults.found, where) from error
    frames = document.get("frames")
    if not isinstance(frames, list) or not all(isinstance(record, dict) for record in frames):
        problem = Problem("is missing or is no list of objects", "not a transforms.json", "give one with frames")
        faults.add(problem, path.name, None, "frames")
        raise ScanError(faults.found, where)
    return document


def _changed() -> Fault:
    return Fault(
        TRANSFORMS, None, "frames", "lists other frames than before", "it was changed since it was read", "start again"
    )


def _stack(poses: list[Float64[ndarray, "4 4"] | None]) -> Poses | None:
    present = [T for T in poses if T is not None]
    return np.stack(present) if present else None
