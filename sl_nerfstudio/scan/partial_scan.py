"""transforms.json as a whole: what could be read of a scan, and everything that could not."""

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.scan.document import TRANSFORMS, document_faults, frame_label, read_document
from sl_nerfstudio.scan.fields import Fields
from sl_nerfstudio.scan.file_error import FileError
from sl_nerfstudio.scan.intrinsics import CAMERA_KEYS, PROJECTOR_KEYS, read_device
from sl_nerfstudio.scan.partial_frame import PartialFrame, check_together, read_frame, read_sigma
from sl_nerfstudio.scan.paths import read_path
from sl_nerfstudio.scan.problem import Faults, Problem
from sl_nerfstudio.scan.scale import check_scale_frames, read_scale
from sl_nerfstudio.scan.types import FORMAT, UNITS, Scale, Scan

_TOP_KEYS = ("sl_format", "units", *CAMERA_KEYS, "projector", "scale", "frames", "sl_pose_sigma")

_NO_PROJECTOR = Problem(
    "is missing: there is no projector in this data set",
    "it is an ordinary data set of nerfstudio, captured without a pattern projector",
    "make a scan from captures of a projected pattern with sl-process",
)


@dataclass
class PartialScan:
    """What could be read of a scan; None where a value is faulty and listed as a fault."""

    root: Path
    units: str | None = None
    scale: Scale | None = None
    projector: Device | None = None
    pattern_path: Path | None = None
    frames: list[PartialFrame] = field(default_factory=list)

    def complete(self) -> Scan:
        """The scan, if no fault was found. Raises ValueError if a value is missing."""
        if self.units is None or self.scale is None or self.projector is None or self.pattern_path is None:
            raise ValueError("a scan with faults cannot be completed")
        frames = tuple(frame.complete() for frame in self.frames)
        return Scan(self.root, self.units, self.scale, self.projector, self.pattern_path, frames)


def read_partial_scan(root: Path, faults: Faults, need_coords: bool = True) -> PartialScan:
    """Everything in transforms.json; what is wrong goes to `faults`. Opens no other file."""
    partial = PartialScan(root)
    try:
        document = read_document(_transforms_path(root))
    except FileError as error:
        faults.add(error, TRANSFORMS)
        return partial
    if _without_projector(document):
        faults.add(_NO_PROJECTOR, TRANSFORMS, None, "projector")
        return partial
    document_faults(document, TRANSFORMS, faults)
    top = Fields(document, faults, TRANSFORMS)
    top.check_spelling(_TOP_KEYS)
    _check_format(top)
    partial.units = top.read_choice("units", list(UNITS), "an unknown unit of length")
    _read_projector(top, partial)
    common_sigma = read_sigma(top)
    records = _frame_records(top)
    common = _read_common_camera(top, records)
    for index, record in enumerate(records):
        if isinstance(record, dict):
            frame = Fields(record, faults, TRANSFORMS, frame_label(record, index))
            partial.frames.append(read_frame(frame, top, root, common, need_coords))
            partial.frames[-1].pose_sigma = read_sigma(frame) or common_sigma
        else:
            problem = Problem("is not an object { .. }", "wrong type", "see docs/scan-format.md")
            faults.add(problem, TRANSFORMS, f"#{index}", "frames")
    partial.scale = read_scale(top, [frame.name for frame in partial.frames])
    if partial.scale is not None:
        check_scale_frames(partial.scale, {frame.name: frame.camera for frame in partial.frames}, faults)
    check_together(partial.frames, faults)
    return partial


def _without_projector(document: dict[str, Any]) -> bool:
    """Whether the file is one of nerfstudio's that was never meant to be a scan: not even a key of this format."""
    frames = document.get("frames")
    ours = {"sl_format", "projector"} & set(document)
    return isinstance(frames, list) and bool(frames) and not ours and not any(map(_has_projector_keys, frames))


def _has_projector_keys(record: Any) -> bool:
    return not isinstance(record, dict) or any(key.startswith(("sl_", "projector")) for key in record)


def _transforms_path(root: Path) -> Path:
    if not os.path.isdir(root):
        what = "is a file, not a folder" if os.path.lexists(root) else "does not exist"
        raise FileError(
            root, f"is missing: {root} {what}", "the path is mistyped", "give the folder that holds transforms.json"
        )
    return root / TRANSFORMS


def _check_format(top: Fields) -> None:
    number = top.read_number("sl_format")
    if number is not None and number != FORMAT:
        top.fault(
            "sl_format", f"is {number:g}", "it was written by a newer version of this package", "update the package"
        )


def _read_projector(top: Fields, partial: PartialScan) -> None:
    section = top.read_section("projector")
    if section is None:
        return
    section.check_spelling(PROJECTOR_KEYS)
    partial.projector = read_device(section, "projector")
    partial.pattern_path = read_path(section, "pattern_path", partial.root)


def _frame_records(top: Fields) -> list[Any]:
    frames = top.record.get("frames")
    if not isinstance(frames, list):
        top.fault(
            "frames",
            "is missing or is not a list",
            "this is not the transforms.json of a scan",
            "give the list of frames, see docs/scan-format.md",
        )
        return []
    if len(frames) < 2:
        top.fault(
            "frames",
            "is empty" if not frames else "holds only one frame",
            "the scan was interrupted, or frames were removed",
            "a scan needs at least two frames from different places",
        )
    return frames


def _read_common_camera(top: Fields, records: list[Any]) -> Device | None:
    """The camera of all frames; None (without a fault) if every frame has its own."""
    own = [isinstance(r, dict) and any(key in r for key in CAMERA_KEYS) for r in records]
    if own and all(own):
        return None
    return read_device(top, "camera")
