"""Intrinsics of camera and projector from the files that calibration programs write.

Where the centre of the first pixel is (0.5, 0.5), as in a scan, or (0, 0):

    plain JSON             (0.5, 0.5); (0, 0) where the file says `"pixel_centre": 0`
    COLMAP cameras.txt     (0.5, 0.5)
    OpenCV .yml .yaml .xml (0, 0): principal points get + 0.5
    procam-calibration     (0, 0); in the projector it measured the first pixel of each Gray-code cell, not its middle
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.calibration.distortion_fit import MOST_PX, reduce_distortion
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Device, DeviceKind
from sl_nerfstudio.scan.document import document_faults, read_document
from sl_nerfstudio.scan.fields import Fields
from sl_nerfstudio.scan.file_error import FileError, read_bytes
from sl_nerfstudio.scan.intrinsics import device_problems
from sl_nerfstudio.scan.problem import Faults

Role = Literal["camera", "projector"]
_MATRIX = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K")
_DISTORTION = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "D")
_SIZE = (("image_width", "image_height"), ("image_Width", "image_Height"))
_PAIRS = (("M1", "D1", "M2", "D2"), ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2"))
# COLMAP's models by their parameters; f stands for both focal lengths
_COLMAP = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
}


@dataclass(frozen=True)
class Entry:
    """One device in a file; its principal point already as in a scan."""

    label: str  # how the file calls it
    role: Role | None
    size: tuple[int, int] | None  # (w, h); None: the file does not say
    matrix: Float64[ndarray, "3 3"]
    distortion: tuple[float, ...]  # OpenCV's order, four to eight
    model: DeviceKind = "OPENCV"


def read_device_file(
    path: Path, role: Role, size: tuple[int, int], model: DeviceKind | None = None, procam_step: int = 1
) -> Device:
    """The camera or the projector in a file of any known format, for images (patterns) of `size` (w, h).

    `model` replaces the projector's model where the format cannot tell. `procam_step` is the graycode_step that
    procam-calibration was run with. Raises UserError with file, cause and remedy.
    """
    entry = _choose(path, read_entries(path, procam_step), role, size)
    device = _device(path, entry, size)
    if model is not None and role == "projector":
        device = replace(device, model=model)
    if role == "camera" and device.model != "OPENCV":
        raise FileError(path, "gives a camera of model DOE", "camera and projector were mixed up", "correct the file")
    for key, problem in device_problems(device):
        raise FileError(path, f"{entry.label}: {key} {problem.problem}", problem.cause, problem.remedy)
    return device


def read_entries(path: Path, procam_step: int = 1) -> list[Entry]:
    """All devices in a file. Raises UserError for files of no known format."""
    suffix = path.suffix.lower()
    if suffix == ".json":
        return _json_entries(path)
    if suffix == ".txt":
        return _colmap_entries(path)
    if suffix in (".yml", ".yaml", ".xml"):
        return _opencv_entries(path, procam_step)
    raise FileError(
        path,
        f"is of no known kind ({suffix or 'no ending'})",
        "known are .json, OpenCV's .yml .yaml .xml, COLMAP's cameras.txt, procam-calibration's calibration_result.xml",
        "convert it to one of these; docs/processing.md shows the plain JSON form",
    )


def _choose(path: Path, entries: list[Entry], role: Role, size: tuple[int, int]) -> Entry:
    """The one entry for a device: by its role, else by its size, else the only one."""
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
            "one file for each device was written",
            "give the other file with --projector-intrinsics" if role == "projector" else "give the camera's file",
        )
    listed = ", ".join(f"{e.label} ({'x'.join(map(str, e.size)) if e.size else 'no size'})" for e in named or free)
    what = "images" if role == "camera" else "pattern"
    raise FileError(
        path,
        f"leaves open which device is the {role}: {listed}; the {what} are {size[0]} x {size[1]}",
        "several devices, or none of this size",
        "leave one device of that size in the file, or give plain JSON with camera and projector",
    )


def _device(path: Path, entry: Entry, size: tuple[int, int]) -> Device:
    w, h = entry.size or size
    if (w, h) != size:
        turned = " (rows and columns exchanged)" if (h, w) == size else ""
        raise FileError(
            path,
            f"{entry.label} was calibrated at {w} x {h}, but the images are {size[0]} x {size[1]}{turned}",
            "the images were resized, cropped or turned after calibrating, or these are another device's intrinsics",
            "give images as they were when calibrating, or calibrate at this size",
        )
    (k1, k2, p1, p2), miss = reduce_distortion(entry.distortion, entry.matrix, size)
    if miss > MOST_PX:
        raise FileError(
            path,
            f"{entry.label}: the lens model has terms beyond k1, k2, p1, p2, without which it is {miss:.2g} px off",
            "calibrated with k3 or the rational model",
            "calibrate with k1, k2, p1, p2 alone (OpenCV: CALIB_FIX_K3), or undistort the images",
        )
    K = entry.matrix
    fl_x, fl_y, cx, cy = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    return Device(w, h, fl_x, fl_y, cx, cy, k1, k2, p1, p2, entry.model)


# ------------------------------------------------------------------ plain JSON


def _json_entries(path: Path) -> list[Entry]:
    """`camera` and `projector` objects; the camera's keys may stand at the top, as in transforms.json."""
    document = read_document(path)
    faults = Faults()
    document_faults(document, path.name, faults)
    top = Fields(document, faults, path.name)
    offset = 0.5 - (top.read_number("pixel_centre", 0.5) or 0.0)
    found: list[Entry | None] = []
    if "camera" in document:
        section = top.read_section("camera")
        found.append(None if section is None else _json_entry(section, "camera", offset))
    elif "fl_x" in document:
        found.append(_json_entry(top, "camera", offset))
    if "projector" in document:
        section = top.read_section("projector")
        found.append(None if section is None else _json_entry(section, "projector", offset))
    if faults.found:
        fault = faults.found[0]
        raise FileError(path, f"{fault.field}: {fault.problem}", fault.cause, fault.remedy)
    if not found:
        raise FileError(
            path, "describes neither a camera nor a projector", "another kind of JSON file",
            'give {"camera": {"w", "h", "fl_x", "fl_y", "cx", "cy", "k1", ..}, "projector": {..}}',
        )  # fmt: skip
    return [entry for entry in found if entry is not None]


def _json_entry(fields: Fields, role: Role, offset: float) -> Entry | None:
    model = "OPENCV"
    for key in ("model", "camera_model"):
        if key in fields.record:
            model = fields.read_choice(key, ("OPENCV", "DOE"), "a model that a scan does not have")
    w, h = fields.read_count("w"), fields.read_count("h")
    numbers = [fields.read_number(key) for key in ("fl_x", "fl_y", "cx", "cy")]
    lens = [fields.read_number(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")]
    if model is None or w is None or h is None or None in numbers or None in lens:
        return None
    matrix = _matrix(*(n or 0.0 for n in numbers), offset=offset)
    kind: DeviceKind = "DOE" if model == "DOE" else "OPENCV"
    return Entry(role, role, (w, h), matrix, tuple(k or 0.0 for k in lens), kind)


def _matrix(fl_x: float, fl_y: float, cx: float, cy: float, offset: float) -> Float64[ndarray, "3 3"]:
    return np.array([[fl_x, 0, cx + offset], [0, fl_y, cy + offset], [0, 0, 1]], dtype=np.float64)


# ------------------------------------------------------------------ COLMAP


def _colmap_entries(path: Path) -> list[Entry]:
    """COLMAP puts the centre of the first pixel at (0.5, 0.5), as a scan does."""
    entries = []
    for number, line in enumerate(read_bytes(path).decode("utf-8", "replace").splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            label, model, w, h = words[0], words[1], int(words[2]), int(words[3])
            values = [float(word) for word in words[4:]]
        except (IndexError, ValueError) as error:
            raise FileError(
                path, f"line {number} is no camera", "not COLMAP's cameras.txt, or it was edited",
                "a line holds: CAMERA_ID MODEL WIDTH HEIGHT PARAMS..",
            ) from error  # fmt: skip
        entries.append(_colmap_entry(path, f"camera {label}", model, (w, h), values))
    if not entries:
        raise FileError(path, "holds no camera", "an empty reconstruction", "export the model from COLMAP again")
    return entries


def _colmap_entry(path: Path, label: str, model: str, size: tuple[int, int], values: list[float]) -> Entry:
    names = _COLMAP.get(model, "").split()
    if not names or len(names) != len(values):
        raise FileError(
            path,
            f"{label} has model {model} with {len(values)} parameters",
            "a lens model that a scan does not have" if not names else f"{model} has {len(names)} parameters",
            f"calibrate with one of {', '.join(_COLMAP)}",
        )
    v = dict(zip(names, values, strict=True))
    matrix = _matrix(v.get("fx", v.get("f", 0.0)), v.get("fy", v.get("f", 0.0)), v["cx"], v["cy"], offset=0.0)
    lens = tuple(v.get(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"))
    return Entry(label, None, size, matrix, lens)


# ------------------------------------------------------------------ OpenCV and procam-calibration


def _opencv_entries(path: Path, procam_step: int) -> list[Entry]:
    stored = _file_storage(path)
    if "cam_int" in stored and "proj_int" in stored:
        return _procam_entries(path, stored, procam_step)
    for m1, d1, m2, d2 in _PAIRS:
        if m1 in stored and m2 in stored:
            return [
                _opencv_entry(path, "camera", "camera", None, stored[m1], stored.get(d1), 0.5),
                _opencv_entry(path, "projector", "projector", None, stored[m2], stored.get(d2), 0.5),
            ]
    matrix = next((stored[key] for key in _MATRIX if key in stored), None)
    if matrix is None:
        raise FileError(
            path,
            f"holds no camera matrix (it has: {', '.join(stored) or 'nothing'})",
            "not a calibration, or one with other names",
            f"name the matrix {_MATRIX[0]} and the lens {_DISTORTION[0]}, as OpenCV's calibration program does",
        )
    size = next(((int(stored[w]), int(stored[h])) for w, h in _SIZE if w in stored and h in stored), None)
    lens = next((stored[key] for key in _DISTORTION if key in stored), None)
    return [_opencv_entry(path, path.name, None, size, matrix, lens, 0.5)]


def _procam_entries(path: Path, stored: dict[str, Any], step: int) -> list[Entry]:
    """Its `img_shape` is (rows, columns) of the camera; the projector's size it does not say."""
    shape = stored.get("img_shape")
    size = None
    if shape is not None:
        rows, columns = np.asarray(shape, dtype=np.float64).reshape(-1)[:2]
        size = (int(columns), int(rows))
    # The projector was measured at `step * cell number`: the first pixel of a cell; its middle is (step - 1) / 2 on.
    return [
        _opencv_entry(path, "cam_int", "camera", size, stored["cam_int"], stored.get("cam_dist"), 0.5),
        _opencv_entry(path, "proj_int", "projector", None, stored["proj_int"], stored.get("proj_dist"), step / 2),
    ]


def _opencv_entry(
    path: Path, label: str, role: Role | None, size: tuple[int, int] | None, matrix: Any, lens: Any, offset: float
) -> Entry:
    K = np.array(matrix, dtype=np.float64)
    k: Sequence[float] = [0.0] * 4 if lens is None else np.array(lens, dtype=np.float64).reshape(-1).tolist()
    if K.shape != (3, 3) or not np.isfinite(K).all() or not np.isfinite(k).all():
        raise FileError(path, f"{label}: is no 3 x 3 matrix of numbers", "a failed calibration", "calibrate again")
    if len(k) not in (4, 5, 8):
        raise FileError(
            path, f"{label}: has {len(k)} distortion coefficients", "a fisheye, thin-prism or tilted model",
            "calibrate with OpenCV's standard model",
        )  # fmt: skip
    K[:2, 2] += offset
    return Entry(label, role, size, K, tuple(k))


def _file_storage(path: Path) -> dict[str, Any]:
    """Everything at the top of an OpenCV file: matrices, numbers, lists of numbers."""
    import cv2

    text = read_bytes(path).decode("utf-8", "replace")
    storage = cv2.FileStorage()
    try:
        opened = storage.open(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root = storage.root() if opened else None
        keys = root.keys() if root is not None and root.isMap() else []
        return {key: _node(storage.getNode(key)) for key in keys}
    except (cv2.error, SystemError, UserError) as error:
        raise FileError(
            path,
            "cannot be read as an OpenCV file",
            "it is damaged, or was written by another program (OpenCV's YAML starts with %YAML:1.0)",
            "write it again with cv2.FileStorage, or give plain JSON",
        ) from error
    finally:
        storage.release()


def _node(node: Any) -> Any:
    if node.isReal() or node.isInt():
        return node.real()
    if node.isString():
        return node.string()
    if node.isSeq():
        return [node.at(k).real() for k in range(node.size())]
    return node.mat()
