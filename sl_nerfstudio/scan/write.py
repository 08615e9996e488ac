"""Writing a scan folder, or a copy of one; other poses and devices for its frames, in a transforms.json beside it."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, UInt8, UInt16
from numpy import ndarray

from sl_nerfstudio.console import track
from sl_nerfstudio.errors import Fault, ScanError, UserError
from sl_nerfstudio.geometry.devices import PARAMETERS, Device
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.scan.coordinates import COORDS_KEYS, UNITS_KEY, encode_coords
from sl_nerfstudio.scan.document import (
    TRANSFORMS,
    Faults,
    Fields,
    FileError,
    Problem,
    Record,
    document_faults,
    frame_label,
    read_bytes,
    read_document,
)
from sl_nerfstudio.scan.images import encode_png
from sl_nerfstudio.scan.read import PICTURES, POSES, SIGMA_KEYS, pose_problem, read_frame_camera, read_pose
from sl_nerfstudio.scan.types import FORMAT, UNITS, GroundTruth, PoseSigma, Scale, Scan, read_device, scale_record
from sl_nerfstudio.storage import NewFolder, write_atomic

# Writing a scan folder, one frame at a time.


class ScanWriter:
    """Writes a scan folder (format 1) frame by frame, and transforms.json last.

    Use it as a context manager. The folder is a scan only after the block has ended; if an exception leaves the block,
    everything written is removed again. Each file is written under a temporary name and renamed. What a killed process
    left is removed by the next writer.

        with ScanWriter(root, units="mm", scale=Scale(False), projector=.., pattern=.., camera=..) as writer:
            writer.add_frame("frame_00000", image=.., coords=.., T_world_camera=.., T_world_projector=..)
    """

    def __init__(
        self,
        root: Path | str,
        *,
        units: str,
        scale: Scale,
        projector: Device,
        pattern: UInt8[ndarray, "h w"] | UInt16[ndarray, "h w"],
        camera: Device | None = None,
        extra: dict[str, Any] | None = None,
        projector_extra: dict[str, Any] | None = None,
        within: NewFolder | None = None,
    ) -> None:
        """Start a folder at `root`, which must not exist or be empty (else UserError).

        `camera` holds the intrinsics common to all frames; None: each frame has its own. `pattern` has the
        projector's size. `extra` holds further top-level keys of transforms.json, `projector_extra` of its projector.
        `within` is a new folder that the caller fills, and that `root` is or lies in: after an exception it is the
        caller's to remove.
        """
        if units not in UNITS:
            raise ValueError(f"units must be one of {', '.join(UNITS)}, got {units!r}")
        if camera is not None and camera.model != "OPENCV":
            raise ValueError("a camera cannot be a DOE")
        if pattern.shape != (projector.h, projector.w):
            raise ValueError(f"the pattern is {pattern.shape}, the projector {(projector.h, projector.w)}")
        self.root = root = Path(root)
        self._camera, self._scale = camera, scale
        self._head: dict[str, Any] = {
            "sl_format": FORMAT,
            "units": units,
            **(device_fields(camera, "camera_model") if camera else {}),
            "projector": {
                **device_fields(projector, "model"),
                "pattern_path": "pattern.png",
                **(projector_extra or {}),
            },
            "scale": scale_record(scale),
            **(extra or {}),
        }
        self._frames: list[dict[str, Any]] = []
        self._truth: list[dict[str, Any]] = []
        self._folder, self._own = within or NewFolder(root), within is None
        self._below = root.relative_to(self._folder.root)
        try:
            self._write("pattern.png", encode_png(pattern))
        except BaseException:
            self._close(complete=False)
            raise

    def __enter__(self) -> "ScanWriter":
        """The writer itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Write transforms.json, or remove everything after an exception."""
        complete = False
        try:
            if kind is None:
                self._finish()
                complete = True
        finally:
            self._close(complete)

    def _close(self, complete: bool) -> None:
        if self._own:
            self._folder.close(complete)

    def add_frame(
        self,
        name: str,
        *,
        image: UInt8[ndarray, "h w *c"] | UInt16[ndarray, "h w *c"],
        coords: Float32[ndarray, "_ _ 2"] | None,
        T_world_camera: Float[ndarray, "4 4"],
        T_world_projector: Float[ndarray, "4 4"],
        pattern: UInt8[ndarray, "_ _"] | UInt16[ndarray, "_ _"] | None = None,
        mask: Bool[ndarray, "_ _"] | None = None,
        color: UInt8[ndarray, "_ _ *channels"] | UInt16[ndarray, "_ _ *channels"] | None = None,
        image_is_color: bool = False,
        camera: Device | None = None,
        pose_sigma: PoseSigma | None = None,
        true_poses: tuple[Float[ndarray, "4 4"], Float[ndarray, "4 4"]] | None = None,
        extra: dict[str, Any] | None = None,
    ) -> None:
        """Write one frame. `name` becomes the stem of its files; `true_poses` (camera, projector) go to ground_truth/.

        `coords` is None only for captures that have not been decoded yet: such a folder does not pass the check.
        `color` is the same view without the pattern; `image_is_color`: the image itself shows no pattern. `camera`
        replaces the common intrinsics; `extra` holds further keys of the frame. Raises ValueError for a name given
        twice, shapes that differ from the camera's, or a pose that is not a rigid motion.
        """
        device = camera or self._camera
        if device is None:
            raise ValueError("a frame needs its own camera if there are no common intrinsics")
        twice = any(frame["file_path"] == f"images/{name}.png" for frame in self._frames)
        if twice or name in ("", ".", "..") or Path(name).name != name:
            raise ValueError(f"frame name {name!r} was given before or is not a file name")
        arrays = {"image": image, "coords": coords, "pattern": pattern, "mask": mask, "color": color}
        for what, array in arrays.items():
            if array is not None and array.shape[:2] != (device.h, device.w):
                raise ValueError(f"{what} of {name} is {array.shape[:2]}, the camera {(device.h, device.w)}")
        frame: dict[str, Any] = {"file_path": self._write(f"images/{name}.png", encode_png(image))}
        if pattern is not None:
            frame["sl_pattern_path"] = self._write(f"patterns/{name}.png", encode_png(pattern))
        if coords is not None:
            frame["sl_coords_path"] = self._write(f"coords/{name}.npz", encode_coords(coords))
        if mask is not None:
            frame["mask_path"] = self._write(f"masks/{name}.png", encode_png(mask.astype(np.uint8) * np.uint8(255)))
        if color is not None:
            frame["sl_color_path"] = self._write(f"color/{name}.png", encode_png(color))
        elif image_is_color:
            frame["sl_color_path"] = frame["file_path"]
        if camera is not None:
            frame.update(device_fields(camera, "camera_model"))
        frame.update(pose_fields(T_world_camera, T_world_projector))
        if pose_sigma is not None:
            frame["sl_pose_sigma"] = sigma_fields(pose_sigma)
        frame.update(extra or {})
        self._frames.append(frame)
        if true_poses is not None:
            self._truth.append({**frame, **pose_fields(*true_poses)})

    def add_file(self, path: str, content: bytes) -> None:
        """Write another file, such as ground_truth/mesh.ply; `path` is relative to the folder."""
        self._write(path, content)

    def _write(self, path: str, content: bytes, last: bool = False) -> str:
        self._folder.write((self._below / path).as_posix(), content, last=last)
        return path

    def _finish(self) -> None:
        if not self._frames:
            raise UserError(f"{self.root}: no frame was written")
        missing = set(self._scale.frames) - {Path(frame["file_path"]).stem for frame in self._frames}
        if missing:
            raise ValueError(f"the known length was measured in {sorted(missing)[0]!r}, which was not written")
        self._settle_intrinsics()
        if self._truth:
            truth = {k: v for k, v in self._head.items() if k != "sl_pose_sigma"}
            frames = [{k: v for k, v in f.items() if k != "sl_pose_sigma"} for f in self._truth]
            self._write("ground_truth/transforms.json", encode_json({**truth, "frames": frames}))
        document = encode_json({**self._head, "frames": self._frames})
        self._write("transforms.json", document, last=self.root == self._folder.root)

    def _settle_intrinsics(self) -> None:
        """Give every frame its own camera if one has: programs differ in which value they use."""
        if self._camera is None or not any("fl_x" in frame for frame in self._frames):
            return
        common = device_fields(self._camera, "camera_model")
        self._head = {key: value for key, value in self._head.items() if key not in common}
        self._frames = [{**common, **frame} for frame in self._frames]
        self._truth = [{**common, **frame} for frame in self._truth]


def device_fields(device: Device, model_key: str) -> dict[str, Any]:
    """A device as keys of transforms.json; `model_key` is "camera_model" or "model"."""
    return {model_key: device.model, **{key: getattr(device, key) for key in ("w", "h", *PARAMETERS)}}


def pose_fields(T_world_camera: Float[ndarray, "4 4"], T_world_projector: Float[ndarray, "4 4"]) -> dict[str, Any]:
    """Both poses of a frame as keys of transforms.json. Raises ValueError unless they are rigid motions."""
    fields: dict[str, Any] = {}
    for key, T in zip(POSES, (T_world_camera, T_world_projector), strict=True):
        problem = pose_problem(np.asarray(T, dtype=np.float64))
        if problem is not None:
            raise ValueError(f"{key} {problem.problem}")
        fields[key] = np.asarray(T, dtype=np.float64).tolist()
    return fields


def sigma_fields(sigma: PoseSigma) -> dict[str, float]:
    """The value of `sl_pose_sigma`."""
    return {key: float(getattr(sigma, key)) for key in sigma.__dataclass_fields__}


def encode_json(document: dict[str, Any]) -> bytes:
    """JSON text as UTF-8; raises ValueError for NaN and infinity, which JSON cannot hold."""
    return (json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()


def encode_intrinsics(units: str, camera: Device, projector: Device) -> bytes:
    """An intrinsics.json of both devices, beside which the pattern is `pattern.png`."""
    own = {**device_fields(projector, "model"), "pattern_path": "pattern.png"}
    return encode_json({"units": units, **device_fields(camera, "camera_model"), "projector": own})


# A copy of a scan folder, with coordinates as arrays.


def write_copy(scan: Scan, output: Path) -> None:
    """Write the scan to a new folder: coordinates as .npz, everything else byte for byte.

    Raises UserError if the folder holds anything, and FileError for a file of the scan that cannot be read.
    """
    document = read_document(scan.root / TRANSFORMS)
    with NewFolder(output) as folder:
        for index, frame in enumerate(track(scan.frames, "writing coordinates")):
            if frame.coords_files is not None:
                folder.write(put_coords(document, index, frame.name), encode_coords(frame.read_coords()))
        copy_others(folder, scan, document)
        folder.write(TRANSFORMS, encode_json(document), last=True)


def put_coords(document: Record, index: int, name: str) -> str:
    """The path of a frame's new coordinates, an array, after it was put into the document."""
    frames = document.get("frames")
    if not isinstance(frames, list) or len(frames) <= index or Path(frames[index]["file_path"]).stem != name:
        raise UserError(
            f"{TRANSFORMS}: has other frames than when it was read\n"
            "    cause:  the file was edited meanwhile\n    remedy: try again"
        )
    document.pop(UNITS_KEY, None)
    for key in (*COORDS_KEYS, UNITS_KEY):
        frames[index].pop(key, None)
    frames[index]["sl_coords_path"] = f"coords/{name}.npz"
    return frames[index]["sl_coords_path"]


def copy_others(folder: NewFolder, scan: Scan, document: Record, without: Sequence[str] = ()) -> None:
    """Every file that transforms.json names, except coordinates; the truth; and descriptions (JSON) beside them."""
    named = [document["projector"]["pattern_path"]]
    named += [record[key] for record in document["frames"] for key in PICTURES if record.get(key)]
    truth = sorted(path for path in (scan.root / GROUND_TRUTH).rglob("*") if path.is_file())
    beside = sorted(path for path in scan.root.glob("*.json") if path.name not in (TRANSFORMS, *without))
    others = [path.relative_to(scan.root).as_posix() for path in (*truth, *beside)]
    for path in track(dict.fromkeys([*named, *others]), "copying"):
        folder.write(path, read_bytes(scan.root / path))


# Poses and devices in another transforms.json: true ones read, refined ones written.

GROUND_TRUTH = "ground_truth"


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
    document = _read(scan.root / TRANSFORMS)
    names = [frame_label(record, index) for index, record in enumerate(document["frames"])]
    if names != [frame.name for frame in scan.frames]:
        changed = "lists other frames than before", "it was changed after it was read", "start again"
        raise ScanError([Fault(TRANSFORMS, None, "frames", *changed)], str(scan.root))
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
    for key in PARAMETERS[:4]:  # focal lengths and principal point
        record.pop(key, None)
        if device is not None:
            record[key] = getattr(device, key)


def read_devices(path: Path, scan: Scan) -> Scan:
    """The scan with the intrinsics of another transforms.json, such as a refined one; its own where that has none.

    Frames are matched by name. Raises ScanError for a device whose numbers cannot be right.
    """
    document, faults = _read(path), Faults()
    top, section, projector = Fields(document, faults, path.name), document.get("projector"), None
    if isinstance(section, dict) and "fl_x" in section:
        projector = read_device(Fields(section, faults, path.name, prefix="projector."), "projector")
    cameras = {
        name: read_frame_camera(Fields(record, faults, path.name, name), top)
        for name, record in _records(document).items()
        if "fl_x" in record or "fl_x" in document
    }
    if faults.found:
        raise ScanError(faults.found, str(path.parent))
    frames = tuple(replace(frame, camera=cameras.get(frame.name) or frame.camera) for frame in scan.frames)
    return replace(scan, projector=projector or scan.projector, frames=frames)


def read_poses(path: Path, scan: Scan) -> DevicePoses:
    """Poses in a transforms.json, in the order of the scan's frames.

    Frames are matched by name (the stem of `file_path`); frames that the scan does not have are ignored. Raises
    ScanError if a frame of the scan is missing, or a pose is faulty or missing, FileError if no frame has one of the
    two kinds of poses.
    """
    cameras, projectors = _both_kinds(_read(path), path, scan)
    if cameras is None or projectors is None:
        missing = POSES[0] if cameras is None else POSES[1]
        raise FileError(
            path, f"has no {missing}", "it is not the transforms.json of a scan", "give one with both poses per frame"
        )
    return DevicePoses(cameras, projectors)


def read_ground_truth(scan: Scan) -> GroundTruth:
    """Read the scan's ground_truth/: mesh.ply, and poses if transforms.json has both kinds.

    Raises ScanError for faulty poses, as `read_poses` does.
    """
    folder = scan.root / GROUND_TRUTH
    mesh, transforms = folder / "mesh.ply", folder / TRANSFORMS
    mesh = mesh if mesh.exists() else None
    if not transforms.exists():
        return GroundTruth(mesh, None, None)
    document = _read(transforms)
    cameras, projectors = _both_kinds(document, transforms, scan)
    poses = None if cameras is None or projectors is None else DevicePoses(cameras, projectors)
    units = document.get("units")
    return GroundTruth(mesh, poses, units if isinstance(units, str) else None)


def read_pose_sigmas(path: Path, scan: Scan) -> list[PoseSigma | None]:
    """Uncertainty of each frame's poses (`sl_pose_sigma`) in a transforms.json, None where it is not stated."""
    found: dict[str, PoseSigma] = {}
    for name, record in _records(_read(path)).items():
        sigma = record.get("sl_pose_sigma")
        if isinstance(sigma, dict) and all(isinstance(sigma.get(key), int | float) for key in SIGMA_KEYS):
            found[name] = PoseSigma(**{key: float(sigma[key]) for key in SIGMA_KEYS})
    return [found.get(frame.name) for frame in scan.frames]


def read_unplaced(path: Path, scan: Scan) -> list[str]:
    """Names of the scan's frames that a transforms.json marks as not agreeing with the others (`sl_unplaced`)."""
    records = _records(_read(path))
    return [f.name for f in scan.frames if f.name in records and records[f.name].get("sl_unplaced") is True]


def _both_kinds(
    document: Record, path: Path, scan: Scan
) -> tuple[Float64[ndarray, "n 4 4"] | None, Float64[ndarray, "n 4 4"] | None]:
    """Camera and projector poses in the order of the scan's frames; None for a kind that no frame has."""
    faults, records = Faults(), _records(document)
    document_faults(document, path.name, faults)
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
    cameras, projectors = ([T for T in found[key] if T is not None] for key in POSES)
    return np.stack(cameras) if cameras else None, np.stack(projectors) if projectors else None


def _records(document: Record) -> dict[str, dict[str, Any]]:
    """The frames of a document by their names."""
    return {frame_label(record, index): record for index, record in enumerate(document["frames"])}


def _read(path: Path) -> Record:
    """A transforms.json with a list of frames. Raises ScanError for anything else."""
    try:
        document = read_document(path)
    except FileError as error:
        fault = Fault(path.name, None, None, error.problem, error.cause, error.remedy)
        raise ScanError([fault], str(path.parent)) from error
    frames = document.get("frames")
    if not isinstance(frames, list) or not all(isinstance(record, dict) for record in frames):
        wrong = "is missing or is not a list of objects", "the file is not a transforms.json", "give one with frames"
        raise ScanError([Fault(path.name, None, "frames", *wrong)], str(path.parent))
    return document
