"""Reading a scan folder."""

import os
import shlex
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.errors import ScanError
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.scan.coordinates import (
    COORDS_KEYS,
    PAIR_KEYS,
    UNITS_KEY,
    CoordinateFiles,
    CoordsUnits,
    read_coords_keys,
    read_coords_size,
    read_half_size,
)
from sl_nerfstudio.scan.document import (
    TRANSFORMS,
    Faults,
    Fields,
    FileError,
    Problem,
    document_faults,
    frame_label,
    read_document,
    read_path,
    unreadable,
)
from sl_nerfstudio.scan.images import ENDINGS, read_header
from sl_nerfstudio.scan.types import (
    CAMERA_KEYS,
    FARTHEST,
    FORMAT,
    PROJECTOR_KEYS,
    UNITS,
    Frame,
    PoseSigma,
    Scale,
    Scan,
    check_scale_frames,
    read_device,
    read_scale,
)

# Whether a matrix is a pose: a rigid motion from device to world.

TOLERANCE = 1e-4  # of the entries of R^T R: text with five digits passes, a scale error of 0.01 % does not


def pose_problem(T: Float64[ndarray, "..."]) -> Problem | None:
    """The first reason why `T` is not a rigid motion, None if it is one."""
    if T.shape == (3, 4):
        return Problem("is 3 x 4", "the last row was left out", "add the row 0, 0, 0, 1")
    if T.shape != (4, 4):
        size = " x ".join(map(str, T.shape)) or "one number"
        return Problem(
            f"is {size} instead of 4 x 4", "it is another kind of matrix", "give the 4 x 4 matrix from device to world"
        )
    if not np.isfinite(T).all():
        return Problem(
            "holds NaN or infinity",
            "registration or calibration failed for this frame",
            "calibrate it again or leave the frame out",
        )
    if np.abs(T[3] - (0, 0, 0, 1)).max() > 1e-9:
        return _last_row_problem(T)
    problem, reach = _rotation_problem(T[:3, :3]), float(np.abs(T[:3, 3]).max())
    if problem is None and reach > FARTHEST:
        return Problem(
            f"puts the device {reach:.2g} units from the origin",
            "registration or calibration diverged for this frame, or the number was damaged",
            "calibrate it again or leave the frame out",
        )
    return problem


def _last_row_problem(T: Float64[ndarray, "4 4"]) -> Problem:
    row = ", ".join(f"{x:g}" for x in T[3])
    if np.abs(T[:, 3] - (0, 0, 0, 1)).max() < 1e-9:
        return Problem(
            f"has the last row {row} and the last column 0, 0, 0, 1",
            "the matrix is transposed (stored column by column)",
            "transpose it: the translation is the last column",
        )
    return Problem(
        f"has the last row {row} instead of 0, 0, 0, 1",
        "the matrix is projective or scaled, or its rows are in another order",
        "give a rigid motion from device to world",
    )


def _rotation_problem(R: Float64[ndarray, "3 3"]) -> Problem | None:
    with np.errstate(over="ignore", invalid="ignore"):
        gram = R.T @ R
        determinant = float(np.linalg.det(R))
    if np.abs(gram - np.eye(3)).max() <= TOLERANCE:
        if determinant > 0:
            return None
        return Problem(
            "is a reflection (the determinant of its rotation is -1)",
            "one axis was negated, or the axes are left-handed (as in Unity or DirectX)",
            "convert to right-handed axes: device looks along -z, +x right, +y up",
        )
    scale = float(np.cbrt(abs(determinant)))
    if scale > 0 and np.abs(gram / scale**2 - np.eye(3)).max() <= TOLERANCE:
        return Problem(
            f"is scaled: its rotation is {scale:.6g} times {'a reflection' if determinant < 0 else 'a rotation'}",
            "a similarity (which includes a scale or a change of unit) was stored as a pose",
            "divide the upper left 3 x 3 block by its scale, and give positions in the scan's unit",
        )
    return Problem(
        "has no rotation in its upper left 3 x 3 block: its columns are not unit vectors at right angles",
        "it was rounded to few digits, is sheared, or is not a pose matrix",
        "give the rotation with at least six digits",
    )


# The frames of transforms.json: what could be read of each, and everything that could not.

POSES = ("transform_matrix", "projector_transform_matrix")
SIGMA_KEYS = tuple(PoseSigma.__dataclass_fields__)
PICTURES = ("file_path", "sl_pattern_path", "mask_path", "sl_color_path")
_FRAME_KEYS = (*PICTURES, *COORDS_KEYS, UNITS_KEY, *POSES, *CAMERA_KEYS, "sl_pose_sigma")


@dataclass
class PartialFrame:
    """What could be read of a frame; None where a value is absent, or faulty and listed as a fault."""

    name: str
    camera: Device | None = None
    paths: dict[str, Path] = field(default_factory=dict)
    coords_units: CoordsUnits | None = None
    T_world_camera: Float64[ndarray, "4 4"] | None = None
    T_world_projector: Float64[ndarray, "4 4"] | None = None
    pose_sigma: PoseSigma | None = None

    @property
    def coords_key(self) -> str:
        """The key that names the coordinates, or the first of two."""
        return next((key for key in COORDS_KEYS if key in self.paths), COORDS_KEYS[0])

    def coords_files(self, projector: Device | None) -> CoordinateFiles | None:
        """The files of the coordinates; None if there are none, or a fault leaves open what they mean."""
        paths = tuple(self.paths[key] for key in COORDS_KEYS if key in self.paths)
        if len(paths) != (2 if self.coords_key in PAIR_KEYS else 1) or self.coords_units is None:
            return None
        if projector is None:
            return CoordinateFiles(paths) if self.coords_units == "pixels" else None
        return CoordinateFiles(paths, self.coords_units, (projector.w, projector.h))

    def complete(self, projector: Device) -> Frame:
        """The frame, if no fault was found."""
        assert self.camera is not None and self.T_world_camera is not None and self.T_world_projector is not None
        image, poses = self.paths["file_path"], (self.T_world_camera, self.T_world_projector)
        pattern, mask, color = map(self.paths.get, PICTURES[1:])
        coords = self.coords_files(projector)
        return Frame(self.name, self.camera, image, pattern, coords, mask, *poses, self.pose_sigma, color)


def read_frame(frame: Fields, top: Fields, root: Path, common: Device | None, need_coords: bool) -> PartialFrame:
    """One frame of transforms.json; `common` is the camera of the frames that have no camera keys."""
    result = PartialFrame(frame.frame or "")
    frame.check_spelling(_FRAME_KEYS)
    result.camera = read_frame_camera(frame, top) if any(key in frame.record for key in CAMERA_KEYS) else common
    for key in PICTURES:
        if key == "file_path" or frame.record.get(key) is not None:
            path = read_path(frame, key, root)
            if path is not None:
                result.paths[key] = path
    coords, result.coords_units = read_coords_keys(frame, top, root, need_coords)
    result.paths |= coords
    result.T_world_camera, result.T_world_projector = (read_pose(frame, key) for key in POSES)
    poses = result.T_world_camera, result.T_world_projector
    if poses[0] is not None and poses[1] is not None and np.array_equal(poses[0][:3, 3], poses[1][:3, 3]):
        frame.fault(
            "projector_transform_matrix",
            "has exactly the position of the camera",
            "the camera's pose was copied, or the calibration is missing",
            "calibrate the projector relative to the camera; without a distance between them there is no depth",
        )
    return result


def read_frame_camera(frame: Fields, top: Fields) -> Device | None:
    """Intrinsics of a frame; keys that it lacks are taken from the scan."""
    both = [key for key in CAMERA_KEYS if key in frame.record and key in top.record]
    differ = [key for key in both if frame.record[key] != top.record[key]]
    for key in differ:
        frame.fault(
            key,
            f"is {frame.record[key]} here but {top.record[key]} for all frames",
            "intrinsics were given twice, and programs differ in which value they use",
            "give each key either once for all frames or in every frame",
        )
    if differ:
        return None
    merged = {**{k: top.record[k] for k in CAMERA_KEYS if k in top.record}, **frame.record}
    return read_device(Fields(merged, frame.faults, frame.file, frame.frame), "camera")


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


def read_sigma(fields: Fields) -> PoseSigma | None:
    """The value of `sl_pose_sigma`; None where it is absent, or after adding a fault."""
    if fields.record.get("sl_pose_sigma") is None:
        return None
    section = fields.read_section("sl_pose_sigma")
    if section is None:
        return None
    section.check_spelling(SIGMA_KEYS)
    values = {key: section.read_number(key) for key in SIGMA_KEYS}
    for key, value in values.items():
        if value is not None and not 0 < value <= FARTHEST:
            cause, size = "a standard deviation must be greater than 0", ", however small"
            if value > 0:
                cause, size = "the adjustment diverged, or the number was damaged", ""
            remedy = f"give the uncertainty of the starting poses{size}, or leave sl_pose_sigma out"
            section.fault(key, f"is {value:g}", cause, remedy)
            return None
    numbers = {key: value for key, value in values.items() if value is not None}
    return PoseSigma(**numbers) if len(numbers) == len(SIGMA_KEYS) else None


def check_together(frames: list[PartialFrame], faults: Faults) -> None:
    """Add the faults that show only when several frames are compared: equal names, or equal poses in all frames."""
    twice = Problem(
        "occurs more than once",
        "a frame was duplicated, or images in two folders have the same name",
        "remove the duplicate, or rename one of the images",
    )
    for name, count in Counter(frame.name for frame in frames).items():
        if count > 1:
            faults.add(twice, TRANSFORMS, name, "file_path")
    pairs = ((f.T_world_camera, f.T_world_projector) for f in frames)
    posed = [
        np.stack([camera, projector]) for camera, projector in pairs if camera is not None and projector is not None
    ]
    if len(posed) == len(frames) > 1 and all(np.array_equal(T, posed[0]) for T in posed):
        problem = Problem(
            "is the same in all frames, for camera and projector",
            "the poses were never filled in, or nothing was moved",
            "register the frames first; a scan needs views from different places",
        )
        faults.add(problem, TRANSFORMS, None, "transform_matrix")


# transforms.json as a whole: what could be read of a scan, and everything that could not.

_SCAN_KEYS = ("sl_format", "units", "projector", "scale", "frames", "sl_pose_sigma", "sl_shrunk_by", UNITS_KEY)
_TOP_KEYS = (*_SCAN_KEYS, *CAMERA_KEYS)

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
    shrunk_by: int = 1

    def complete(self) -> Scan:
        """The scan, if no fault was found."""
        assert self.units is not None and self.scale is not None
        assert self.projector is not None and self.pattern_path is not None
        frames, shrunk_by = tuple(frame.complete(self.projector) for frame in self.frames), self.shrunk_by
        return Scan(self.root, self.units, self.scale, self.projector, self.pattern_path, frames, shrunk_by=shrunk_by)


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
    number = top.read_number("sl_format")
    if number is not None and number != FORMAT:
        cause = "it was written by a newer version of this package"
        top.fault("sl_format", f"is {number:g}", cause, "update the package")
    partial.units = top.read_choice("units", list(UNITS), "an unknown unit of length")
    if "sl_shrunk_by" in document:
        partial.shrunk_by = top.read_count("sl_shrunk_by") or 1
    section = top.read_section("projector")
    if section is not None:
        section.check_spelling(PROJECTOR_KEYS)
        partial.projector = read_device(section, "projector")
        partial.pattern_path = read_path(section, "pattern_path", root)
    common_sigma = read_sigma(top)
    records = _frame_records(top)
    all_own = all(isinstance(record, dict) and any(key in record for key in CAMERA_KEYS) for record in records)
    common = None if records and all_own else read_device(top, "camera")
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
    if not isinstance(frames, list) or not frames or {"sl_format", "projector"} & set(document):
        return False
    return all(
        isinstance(record, dict) and not any(key.startswith(("sl_", "projector")) for key in record)
        for record in frames
    )


def _transforms_path(root: Path) -> Path:
    if not os.path.isdir(root):
        what = "is a file, not a folder" if os.path.lexists(root) else "does not exist"
        raise FileError(
            root, f"is missing: {root} {what}", "the path is mistyped", "give the folder that holds transforms.json"
        )
    if not os.path.lexists(root / TRANSFORMS):
        raise _no_scan(root)
    return root / TRANSFORMS


def _no_scan(root: Path) -> FileError:
    """The error of a folder without transforms.json, by what it holds instead."""
    try:
        scans = [path for path in _folders(root) if (path / TRANSFORMS).is_file()]
        parts = sorted(path.name for path in root.glob("transforms_*.json"))
        captures = None if (root / "coords").is_dir() else _captures_in(root)
    except OSError as error:
        return unreadable(root, error)
    missing = f"is missing in {root}"
    if len(scans) == 1:
        return FileError(root, f"{missing}; there is one in {scans[0].name}", "a folder too high", f"give {scans[0]}")
    if parts:
        return FileError(
            root,
            f"{missing}, but there is {', '.join(parts[:3])}",
            "this is a data set in parts, as Blender's are, captured without a pattern projector",
            "make a scan from captures of a projected pattern with sl-process; if it is a scan, rename its file to "
            f"{TRANSFORMS}",
        )
    if captures is not None:
        return FileError(
            root,
            f"{missing}: these are photographs, not a scan",
            "a scan is made from photographs by sl-process",
            f"make one: sl-process --images {shlex.quote(str(captures))} --pattern pattern.json --intrinsics "
            "intrinsics.json --output scan; then give the folder scan",
        )
    return FileError(
        root, missing, "it was moved, renamed or never written, or its name differs in upper and lower case",
        "give the folder that holds transforms.json; sl-process makes one from photographs",
    )  # fmt: skip


def _captures_in(root: Path) -> Path | None:
    """The folder that sl-process takes, if `root` holds photographs: itself, or a folder in it."""

    def pictures(folder: Path) -> bool:
        return any(path.suffix.lower() in ENDINGS for path in folder.iterdir())

    frames = [folder for folder in _folders(root) if pictures(folder)]
    if pictures(root) or len(frames) > 1:
        return root
    around = [folder for folder in _folders(root) if any(map(pictures, _folders(folder)))]
    return next(iter([*frames, *around]), None)


def _folders(root: Path) -> list[Path]:
    return sorted(path for path in root.iterdir() if path.is_dir() and not path.name.startswith("."))


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


# The headers of a scan's files: do the files exist, are they of the right kind and size? Decodes nothing.

_CHECKED = (*PICTURES, *COORDS_KEYS)
_MAY_BE_COLOUR = ("file_path", "sl_color_path")


def check_headers(partial: PartialScan, faults: Faults) -> set[Path]:
    """Check the headers of all files; return the files that can be decoded."""
    files = [(None, "pattern_path", partial.pattern_path, _size_of(partial.projector), "the projector has")]
    for frame in partial.frames:
        size, whose = _size_of(frame.camera), "the camera has"
        if size is None and (coords := frame.paths.get(frame.coords_key)) is not None:
            with suppress(FileError):
                size, whose = _coords_size(frame.coords_key, coords), "its coordinates are"
        files += [(frame.name, key, frame.paths.get(key), size, whose) for key in _CHECKED]
    good: set[Path] = set()
    for frame_name, key, path, size, whose in files:
        if path is not None:
            problems = list(_header_problems(key, path, size, whose))
            for problem in problems:
                faults.add(problem, relative(path, partial.root), frame_name)
            if not problems:
                good.add(path)
    return good


def _size_of(device: Device | None) -> tuple[int, int] | None:
    return None if device is None else (device.w, device.h)


def relative(path: Path, root: Path) -> str:
    """Name of a file in messages: its path below the folder, with slashes."""
    return path.relative_to(root).as_posix()


def _header_problems(key: str, path: Path, wanted: tuple[int, int] | None, whose: str) -> Iterator[Problem | FileError]:
    """What is wrong with a file by its header; `wanted`: the size that it must have, None if that is not known."""
    try:
        header = None if key in COORDS_KEYS else read_header(path)
        size = _coords_size(key, path) if header is None else (header.w, header.h)
    except FileError as error:
        yield error
        return
    if wanted is not None and size != wanted:
        yield _wrong_size(size, wanted, whose)
    if header is not None and header.mode != "grey" and key not in _MAY_BE_COLOUR:
        yield Problem("is in colour", "it was saved by a program that writes only RGB", "save it as grey, 8 or 16 bit")


def _coords_size(key: str, path: Path) -> tuple[int, int]:
    return read_coords_size(path) if key == "sl_coords_path" else read_half_size(path)


def _wrong_size(found: tuple[int, int], wanted: tuple[int, int], whose: str) -> Problem:
    if found == wanted[::-1]:
        cause = "width and height are swapped: the image was rotated, or w and h were swapped"
    elif found[0] * wanted[1] == found[1] * wanted[0]:
        cause = "it was resized, or the intrinsics are those of another resolution"
    else:
        cause = "it was cropped, or comes from another camera or scan"
    return Problem(
        f"is {found[0]} x {found[1]} pixels, but {whose} {wanted[0]} x {wanted[1]}",
        cause,
        "give the original file, or the intrinsics (w, h, fl_x, fl_y, cx, cy) of this one",
    )


def read_scan(root: Path | str, need_coords: bool = True) -> Scan:
    """The scan in a folder, after quick checks: transforms.json, paths, poses and the headers of all files.

    No pixel is decoded. `need_coords=False` accepts frames that were not decoded yet. Raises ScanError with all
    faults found.
    """
    root = Path(os.path.realpath(root))
    faults = Faults()
    partial = read_partial_scan(root, faults, need_coords)
    check_headers(partial, faults)
    if faults.found:
        raise ScanError(faults.found, str(root))
    return partial.complete()
