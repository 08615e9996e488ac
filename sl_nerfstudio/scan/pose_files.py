"""Other poses and devices for the frames of a scan: true ones read, refined ones written, as a transforms.json."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.errors import Fault, ScanError
from sl_nerfstudio.files.atomic import write_atomic
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.scan.document import TRANSFORMS, Record, document_faults, frame_label, read_document
from sl_nerfstudio.scan.fields import Fields
from sl_nerfstudio.scan.file_error import FileError
from sl_nerfstudio.scan.intrinsics import read_device
from sl_nerfstudio.scan.partial_frame import POSES, SIGMA_KEYS, read_frame_camera, read_pose
from sl_nerfstudio.scan.problem import Faults, Problem
from sl_nerfstudio.scan.types import GroundTruth, PoseSigma, Scan
from sl_nerfstudio.scan.writing import encode_json, pose_fields

GROUND_TRUTH = "ground_truth"
_FOCAL_AND_CENTRE = ("fl_x", "fl_y", "cx", "cy")
_Poses = Float64[ndarray, "n 4 4"]


def write_transforms(
    path: Path,
    scan: Scan,
    poses: DevicePoses,
    extra_frame_fields: Sequence[dict[str, Any]] | None = None,
    extra_fields: dict[str, Any] | None = None,
) -> None:
    """Write a copy of the scan's transforms.json with other poses, and with the scan's intrinsics if they were changed.

    Everything else is kept, unknown keys too, except `sl_pose_sigma` and `sl_unplaced`, which describe the poses
    replaced here. Paths are kept as they are, relative to the scan folder: to use the copy, put it there in place of
    the original.
    `extra_frame_fields` (one per frame, in the scan's order) and `extra_fields` add or replace keys. The file appears
    complete or not at all. Raises ValueError for poses that are not rigid motions or not one per frame, ScanError if
    the scan's file was changed meanwhile.
    """
    extras = [{}] * len(scan.frames) if extra_frame_fields is None else extra_frame_fields
    if not len(poses) == len(extras) == len(scan.frames):
        raise ValueError(f"{len(scan.frames)} frames, but poses of {len(poses)} and {len(extras)} sets of fields")
    document = _read(scan.root / TRANSFORMS, str(scan.root))
    names = [frame_label(record, index) for index, record in enumerate(document["frames"])]
    if names != [frame.name for frame in scan.frames]:
        raise ScanError([_changed()], str(scan.root))
    document.pop("sl_pose_sigma", None)
    for index, record in enumerate(document["frames"]):
        record.pop("sl_pose_sigma", None)
        record.pop("sl_unplaced", None)
        record.update(pose_fields(poses.T_world_camera[index], poses.T_world_projector[index]))
        record.update(extras[index])
    if scan.intrinsics_change:
        _put_devices(document, scan)
    write_atomic(path, encode_json({**document, **(extra_fields or {})}))


def _put_devices(document: Record, scan: Scan) -> None:
    """The scan's focal lengths and principal points: once at the top if all cameras are alike, else in every frame."""
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

    Frames are matched by name. Raises ScanError for a device whose numbers cannot be right.
    """
    document = _read(path, str(path.parent))
    faults = Faults()
    projector, cameras = _document_devices(document, path.name, faults)
    if faults.found:
        raise ScanError(faults.found, str(path.parent))
    frames = tuple(replace(frame, camera=cameras.get(frame.name, frame.camera)) for frame in scan.frames)
    return replace(scan, projector=projector or scan.projector, frames=frames)


def _document_devices(document: Record, file: str, faults: Faults) -> tuple[Device | None, dict[str, Device]]:
    """The projector, and the camera of each frame by its name, as far as the document has them."""
    top = Fields(document, faults, file)
    section = document.get("projector")
    projector = None
    if isinstance(section, dict) and "fl_x" in section:
        projector = read_device(Fields(section, faults, file, prefix="projector."), "projector")
    cameras: dict[str, Device] = {}
    for index, record in enumerate(document["frames"]):
        if "fl_x" in record or "fl_x" in document:
            name = frame_label(record, index)
            camera = read_frame_camera(Fields(record, faults, file, name), top)
            if camera is not None:
                cameras[name] = camera
    return projector, cameras


def read_poses(path: Path, scan: Scan) -> DevicePoses:
    """Poses in a transforms.json, in the order of the scan's frames.

    Frames are matched by name (the stem of `file_path`); frames that the scan does not have are ignored. Raises
    ScanError if a frame of the scan is missing, or a pose is faulty or missing, FileError if no frame has one of the
    two kinds of poses.
    """
    cameras, projectors = _read_both_kinds(path, scan)
    if cameras is None or projectors is None:
        missing = POSES[0] if cameras is None else POSES[1]
        raise FileError(
            path, f"has no {missing}", "it is not the transforms.json of a scan", "give one with both poses per frame"
        )
    return DevicePoses(cameras, projectors)


def read_ground_truth(scan: Scan) -> GroundTruth:
    """What the scan's ground_truth/ holds: mesh.ply, and poses if transforms.json has both kinds.

    Raises ScanError for faulty poses, as `read_poses` does.
    """
    folder = scan.root / GROUND_TRUTH
    mesh, transforms = folder / "mesh.ply", folder / TRANSFORMS
    cameras, projectors = _read_both_kinds(transforms, scan) if transforms.exists() else (None, None)
    poses = None if cameras is None or projectors is None else DevicePoses(cameras, projectors)
    units = _read(transforms, str(folder)).get("units") if transforms.exists() else None
    return GroundTruth(mesh if mesh.exists() else None, poses, units if isinstance(units, str) else None)


def read_pose_sigmas(path: Path, scan: Scan) -> list[PoseSigma | None]:
    """Uncertainty of each frame's poses (`sl_pose_sigma`) in a transforms.json, None where it is not stated."""
    found: dict[str, PoseSigma] = {}
    for index, record in enumerate(_read(path, str(path.parent))["frames"]):
        sigma = record.get("sl_pose_sigma")
        if isinstance(sigma, dict) and all(isinstance(sigma.get(key), int | float) for key in SIGMA_KEYS):
            found[frame_label(record, index)] = PoseSigma(**{key: float(sigma[key]) for key in SIGMA_KEYS})
    return [found.get(frame.name) for frame in scan.frames]


def read_unplaced(path: Path, scan: Scan) -> list[str]:
    """Names of the scan's frames that a transforms.json marks as not agreeing with the others (`sl_unplaced`)."""
    records = enumerate(_read(path, str(path.parent))["frames"])
    marked = {frame_label(record, index) for index, record in records if record.get("sl_unplaced") is True}
    return [frame.name for frame in scan.frames if frame.name in marked]


def _read_both_kinds(
    path: Path, scan: Scan
) -> tuple[Float64[ndarray, "n 4 4"] | None, Float64[ndarray, "n 4 4"] | None]:
    """Camera and projector poses in the order of the scan's frames; None for a kind that no frame has."""
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
                "these poses are those of another scan, or its frames were renamed",
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


def _read(path: Path, where: str) -> Record:
    faults = Faults()
    try:
        document = read_document(path)
    except FileError as error:
        faults.add(error, path.name)
        raise ScanError(faults.found, where) from error
    frames = document.get("frames")
    if not isinstance(frames, list) or not all(isinstance(record, dict) for record in frames):
        problem = Problem(
            "is missing or is not a list of objects", "the file is not a transforms.json", "give one with frames"
        )
        faults.add(problem, path.name, None, "frames")
        raise ScanError(faults.found, where)
    return document


def _changed() -> Fault:
    return Fault(
        TRANSFORMS, None, "frames", "lists other frames than before", "it was changed after it was read", "start again"
    )


def _stack(poses: list[Float64[ndarray, "4 4"] | None]) -> _Poses | None:
    present = [T for T in poses if T is not None]
    return np.stack(present) if present else None
