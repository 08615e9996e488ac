"""transforms.json taken apart: what could be read of each frame, and everything that could not."""

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.scan.document import Record, document_faults, frame_label, read_document
from sl_nerfstudio.scan.fields import Fields
from sl_nerfstudio.scan.file_error import FileError
from sl_nerfstudio.scan.intrinsics import CAMERA_KEYS, PROJECTOR_KEYS, read_device
from sl_nerfstudio.scan.paths import resolve_inside
from sl_nerfstudio.scan.poses import pose_problem
from sl_nerfstudio.scan.problem import Faults, Problem
from sl_nerfstudio.scan.types import FORMAT, UNITS, Frame, PoseSigma, Scale, Scan

TRANSFORMS = "transforms.json"
POSES = ("transform_matrix", "projector_transform_matrix")
_PATHS = ("file_path", "sl_pattern_path", "sl_coords_path", "mask_path")
_TOP_KEYS = ("sl_format", "units", *CAMERA_KEYS, "projector", "scale", "frames", "sl_pose_sigma")
_FRAME_KEYS = (*_PATHS, *POSES, *CAMERA_KEYS, "sl_pose_sigma")
_SIGMA_KEYS = tuple(PoseSigma.__dataclass_fields__)


@dataclass
class PartialFrame:
    """What could be read of a frame; None: absent, or faulty and listed."""

    name: str
    camera: Device | None = None
    paths: dict[str, Path] = field(default_factory=dict)
    T_world_camera: Float64[ndarray, "4 4"] | None = None
    T_world_projector: Float64[ndarray, "4 4"] | None = None
    pose_sigma: PoseSigma | None = None


@dataclass
class PartialScan:
    """What could be read of a scan; None: faulty and listed."""

    root: Path
    units: str | None = None
    scale: Scale | None = None
    projector: Device | None = None
    pattern_path: Path | None = None
    frames: list[PartialFrame] = field(default_factory=list)

    def complete(self) -> Scan:
        """The scan, once no fault was found. Raises ValueError for a draft with gaps."""
        if self.units is None or self.scale is None or self.projector is None or self.pattern_path is None:
            raise ValueError("a draft with faults is no scan")
        frames = tuple(_complete_frame(frame) for frame in self.frames)
        return Scan(self.root, self.units, self.scale, self.projector, self.pattern_path, frames)


def read_partial_scan(root: Path, faults: Faults, need_coords: bool = True) -> PartialScan:
    """Everything that transforms.json says, adding what is wrong to `faults`; opens no other file."""
    draft = PartialScan(root)
    try:
        document = read_document(_transforms_path(root))
    except FileError as error:
        faults.add(error, TRANSFORMS)
        return draft
    document_faults(document, TRANSFORMS, faults)
    top = Fields(document, faults, TRANSFORMS)
    top.check_spelling(_TOP_KEYS)
    _check_format(top)
    draft.units = top.read_choice("units", list(UNITS), "an unknown unit of length")
    draft.scale = _read_scale(top)
    _read_projector(top, draft)
    common_sigma = _read_sigma(top)
    records = _frame_records(top)
    common = _read_common_camera(top, records)
    for index, record in enumerate(records):
        if isinstance(record, dict):
            frame = Fields(record, faults, TRANSFORMS, frame_label(record, index))
            draft.frames.append(_read_frame(frame, top, draft, common, need_coords))
            draft.frames[-1].pose_sigma = _read_sigma(frame) or common_sigma
        else:
            faults.add(
                Problem("is no object { .. }", "wrong type", "see docs/scan-format.md"),
                TRANSFORMS,
                f"#{index}",
                "frames",
            )
    _check_together(draft.frames, faults)
    return draft


def _transforms_path(root: Path) -> Path:
    if not os.path.isdir(root):
        what = "is a file, not a folder" if os.path.lexists(root) else "does not exist"
        raise FileError(
            root, f"is missing: {root} {what}", "a slip in the path", "give the folder that holds transforms.json"
        )
    return root / TRANSFORMS


def _check_format(top: Fields) -> None:
    number = top.read_number("sl_format")
    if number is not None and number != FORMAT:
        top.fault("sl_format", f"is {number:g}", "written by a newer version of this package", "update the package")


def _read_scale(top: Fields) -> Scale | None:
    section = top.read_section("scale")
    if section is None:
        return None
    section.check_spelling(("known", "source"))
    known = section.read_flag("known")
    source = section.read_optional_text("source") if section.record.get("source") != "" else ""
    return None if known is None else Scale(known, source or "")


def _read_projector(top: Fields, draft: PartialScan) -> None:
    section = top.read_section("projector")
    if section is None:
        return
    section.check_spelling(PROJECTOR_KEYS)
    draft.projector = read_device(section, "projector")
    draft.pattern_path = _read_path(section, "pattern_path", draft.root)


def _frame_records(top: Fields) -> list[Any]:
    frames = top.record.get("frames")
    if not isinstance(frames, list):
        top.fault(
            "frames",
            "is missing or is no list",
            "not a transforms.json of a scan",
            "give the list of frames, see docs/scan-format.md",
        )
        return []
    if len(frames) < 2:
        top.fault(
            "frames",
            "is empty" if not frames else "holds one frame only",
            "the scan was broken off, or frames were removed",
            "a scan needs at least two frames from different places",
        )
    return frames


def _read_common_camera(top: Fields, records: list[Any]) -> Device | None:
    """The camera of all frames; None (without fault) if each frame brings its own."""
    own = [isinstance(r, dict) and any(key in r for key in CAMERA_KEYS) for r in records]
    if own and all(own):
        return None
    return read_device(top, "camera")


def _read_frame(
    frame: Fields, top: Fields, draft: PartialScan, common: Device | None, need_coords: bool
) -> PartialFrame:
    result = PartialFrame(frame.frame or "")
    frame.check_spelling(_FRAME_KEYS)
    result.camera = _frame_camera(frame, top) if any(key in frame.record for key in CAMERA_KEYS) else common
    for key in _PATHS:
        if key == "file_path" or (key == "sl_coords_path" and need_coords) or frame.record.get(key) is not None:
            path = _read_path(frame, key, draft.root)
            if path is not None:
                result.paths[key] = path
    result.T_world_camera, result.T_world_projector = (read_pose(frame, key) for key in POSES)
    if result.T_world_camera is not None and result.T_world_projector is not None:
        _check_baseline(frame, result.T_world_camera, result.T_world_projector)
    return result


def _frame_camera(frame: Fields, top: Fields) -> Device | None:
    """Intrinsics of a frame; keys that it lacks are the common ones."""
    both = [key for key in CAMERA_KEYS if key in frame.record and key in top.record]
    differ = [key for key in both if frame.record[key] != top.record[key]]
    for key in differ:
        frame.fault(
            key,
            f"is {frame.record[key]} here but {top.record[key]} for all frames",
            "intrinsics were given twice; programs differ in which they believe",
            "give each key either for all frames or in every frame",
        )
    if differ:
        return None
    merged = {**{k: top.record[k] for k in CAMERA_KEYS if k in top.record}, **frame.record}
    return read_device(Fields(merged, frame.faults, frame.file, frame.frame), "camera")


def document_devices(document: Record, file: str, faults: Faults) -> tuple[Device | None, dict[str, Device]]:
    """The projector, and the camera of each frame by its name, of a document that may say nothing of them."""
    top = Fields(document, faults, file)
    section = document.get("projector")
    projector = None
    if isinstance(section, dict) and "fl_x" in section:
        projector = read_device(Fields(section, faults, file, prefix="projector."), "projector")
    cameras: dict[str, Device] = {}
    for index, record in enumerate(document["frames"]):
        if "fl_x" in record or "fl_x" in document:
            name = frame_label(record, index)
            camera = _frame_camera(Fields(record, faults, file, name), top)
            if camera is not None:
                cameras[name] = camera
    return projector, cameras


def _read_path(fields: Fields, key: str, root: Path) -> Path | None:
    text = fields.read_text(key)
    if text is None:
        return None
    path = resolve_inside(root, text)
    if isinstance(path, Path):
        return path
    fields.faults.add(path, fields.file, fields.frame, fields.prefix + key)
    return None


def read_pose(frame: Fields, key: str) -> Float64[ndarray, "4 4"] | None:
    """The pose under `key`; None after adding a fault."""
    matrix = frame.read_matrix(key)
    if matrix is None:
        return None
    problem = pose_problem(matrix)
    if problem is None:
        return matrix
    frame.faults.add(problem, frame.file, frame.frame, key)
    return None


def _check_baseline(
    frame: Fields, T_world_camera: Float64[ndarray, "4 4"], T_world_projector: Float64[ndarray, "4 4"]
) -> None:
    if np.array_equal(T_world_camera[:3, 3], T_world_projector[:3, 3]):
        frame.fault(
            "projector_transform_matrix",
            "stands in the very place of the camera",
            "the camera's pose was copied, or the calibration is missing",
            "calibrate the projector against the camera; without a distance between them there is no depth",
        )


def _read_sigma(fields: Fields) -> PoseSigma | None:
    if fields.record.get("sl_pose_sigma") is None:
        return None
    section = fields.read_section("sl_pose_sigma")
    if section is None:
        return None
    section.check_spelling(_SIGMA_KEYS)
    values = {key: section.read_number(key) for key in _SIGMA_KEYS}
    for key, value in values.items():
        if value is not None and value <= 0:
            section.fault(
                key, f"is {value:g}", "a standard deviation is above 0",
                "give the uncertainty of the starting poses, however small, or leave sl_pose_sigma out",
            )  # fmt: skip
            return None
    numbers = {key: value for key, value in values.items() if value is not None}
    return PoseSigma(**numbers) if len(numbers) == len(_SIGMA_KEYS) else None


def _check_together(frames: list[PartialFrame], faults: Faults) -> None:
    """Faults that only several frames together have."""
    seen: set[str] = set()
    for frame in frames:
        if frame.name in seen:
            faults.add(
                Problem(
                    "is there more than once",
                    "a frame was duplicated, or images in two folders share a name",
                    "remove the duplicate, or rename one of the images",
                ),
                TRANSFORMS,
                frame.name,
                "file_path",
            )
        seen.add(frame.name)
    posed = [f for f in frames if f.T_world_camera is not None and f.T_world_projector is not None]
    if len(posed) < 2 or len(posed) != len(frames):
        return
    if all(_same_poses(frame, posed[0]) for frame in posed[1:]):
        faults.add(
            Problem(
                "is the same in all frames, for camera and projector",
                "the poses were never filled in, or nothing was moved",
                "register the frames first; a scan needs views from different places",
            ),
            TRANSFORMS,
            None,
            "transform_matrix",
        )


def _same_poses(a: PartialFrame, b: PartialFrame) -> bool:
    pairs = ((a.T_world_camera, b.T_world_camera), (a.T_world_projector, b.T_world_projector))
    return all(x is not None and y is not None and np.array_equal(x, y) for x, y in pairs)


def _complete_frame(draft: PartialFrame) -> Frame:
    if draft.camera is None or draft.T_world_camera is None or draft.T_world_projector is None:
        raise ValueError("a draft with faults is no scan")
    return Frame(
        name=draft.name,
        camera=draft.camera,
        image_path=draft.paths["file_path"],
        pattern_path=draft.paths.get("sl_pattern_path"),
        coords_path=draft.paths.get("sl_coords_path"),
        mask_path=draft.paths.get("mask_path"),
        T_world_camera=draft.T_world_camera,
        T_world_projector=draft.T_world_projector,
        pose_sigma=draft.pose_sigma,
    )
