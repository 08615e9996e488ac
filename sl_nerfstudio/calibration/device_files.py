"""The camera or the projector in an intrinsics file: its format, the right entry, and whether it can be used."""

from dataclasses import replace
from pathlib import Path

from sl_nerfstudio.calibration.distortion_fit import LARGEST_MISS_PX, reduce_distortion
from sl_nerfstudio.calibration.formats.colmap import read_colmap_entries
from sl_nerfstudio.calibration.formats.entry import DeviceEntry, Role
from sl_nerfstudio.calibration.formats.file_storage import read_file_storage
from sl_nerfstudio.calibration.formats.opencv import opencv_entries
from sl_nerfstudio.calibration.formats.plain_json import read_json_entries
from sl_nerfstudio.calibration.formats.procam import is_procam, procam_entries
from sl_nerfstudio.geometry.devices import Device, DeviceKind
from sl_nerfstudio.scan.file_error import FileError
from sl_nerfstudio.scan.intrinsics import device_problems

_MISSING: dict[Role, str] = {
    "projector": "give its file with --projector-intrinsics, or find it from the captures: --estimate-projector",
    "camera": "give the camera's file",
}


def read_device_file(
    path: Path,
    role: Role,
    size: tuple[int, int],
    model: DeviceKind | None = None,
    procam_step: int = 1,
    name: str = "",
) -> Device:
    """The camera or the projector in a file of any known format, for images (patterns) of `size` (w, h).

    `model` replaces the projector's model, which some formats cannot state. `procam_step` is the graycode_step with
    which procam-calibration was run; `name` is that of the device in a file with several cameras. Raises UserError with
    file, cause and remedy.
    """
    entry = chosen_entry(path, role, size, procam_step, name)
    device = _device(path, entry, size)
    if model is not None and role == "projector":
        device = replace(device, model=model)
    if role == "camera" and device.model != "OPENCV":
        raise FileError(path, "gives a camera of model DOE", "camera and projector were mixed up", "correct the file")
    for key, problem in device_problems(device):
        raise FileError(path, f"{entry.label}: {key} {problem.problem}", problem.cause, problem.remedy)
    return device


def chosen_entry(path: Path, role: Role, size: tuple[int, int], procam_step: int = 1, name: str = "") -> DeviceEntry:
    """What the file says of a device, as it stands there; arguments and errors are those of `read_device_file`."""
    entries = [entry for entry in read_entries(path, procam_step) if name in ("", entry.label)]
    return _choose(path, entries, role, size)


def read_entries(path: Path, procam_step: int = 1) -> list[DeviceEntry]:
    """All devices in a file. Raises FileError for files of unknown format."""
    suffix = path.suffix.lower()
    if suffix == ".json":
        return read_json_entries(path)
    if suffix == ".txt":
        return read_colmap_entries(path)
    if suffix in (".yml", ".yaml", ".xml"):
        stored = read_file_storage(path)
        return procam_entries(path, stored, procam_step) if is_procam(stored) else opencv_entries(path, stored)
    raise FileError(
        path,
        f"is of no known kind ({suffix or 'no ending'})",
        "known are .json, OpenCV's .yml .yaml .xml, COLMAP's cameras.txt, procam-calibration's calibration_result.xml",
        "convert it to one of these; docs/processing.md shows the plain JSON form",
    )


def _choose(path: Path, entries: list[DeviceEntry], role: Role, size: tuple[int, int]) -> DeviceEntry:
    """The one entry for a device: by its role, otherwise by its size, otherwise the only one."""
    named = [e for e in entries if e.role == role]
    free = [e for e in entries if e.role is None]
    fitting = [e for e in free if e.size in (size, None)]
    for candidates in (named, fitting, free if len(entries) == 1 else []):
        if len(candidates) == 1:
            return candidates[0]
    if not named and not free:
        raise FileError(
            path,
            f"describes no {role}, only {', '.join(e.label for e in entries)}",
            "each device has its own file",
            _MISSING[role],
        )
    listed = ", ".join(f"{e.label} ({'x'.join(map(str, e.size)) if e.size else 'no size'})" for e in named or free)
    what = "images" if role == "camera" else "pattern"
    raise FileError(
        path,
        f"does not say which device is the {role}: {listed}; the {what} are {size[0]} x {size[1]}",
        "several devices, or none of this size",
        "leave one device of that size in the file, or give plain JSON with camera and projector",
    )


def _device(path: Path, entry: DeviceEntry, size: tuple[int, int]) -> Device:
    """The entry as a device for images of `size`. Raises FileError if it is for other images or another lens model."""
    w, h = entry.size or size
    if (w, h) != size:
        turned = " (rows and columns exchanged)" if (h, w) == size else ""
        raise FileError(
            path,
            f"{entry.label} was calibrated at {w} x {h}, but the images are {size[0]} x {size[1]}{turned}",
            "the images were resized, cropped or turned after calibration, or these are another device's intrinsics",
            "give images as they were in the calibration, or calibrate at this size",
        )
    (k1, k2, p1, p2), miss = reduce_distortion(entry.distortion, entry.matrix, size)
    if miss > LARGEST_MISS_PX:
        raise FileError(
            path,
            f"{entry.label}: the lens model has terms beyond k1, k2, p1, p2, without which it is {miss:.2g} px off",
            "calibrated with k3 or the rational model",
            "calibrate with k1, k2, p1, p2 alone (OpenCV: CALIB_FIX_K3), or undistort the images",
        )
    K = entry.matrix
    fl_x, fl_y, cx, cy = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    return Device(w, h, fl_x, fl_y, cx, cy, k1, k2, p1, p2, entry.model)
