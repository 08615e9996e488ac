"""The camera or the projector in an intrinsics file: its format, the right entry, and whether it can be used."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.calibration.stored_values import STORED, read_stored_values
from sl_nerfstudio.geometry.devices import Device, DeviceKind
from sl_nerfstudio.scan.document import Faults, Fields, FileError, document_faults, read_bytes, read_document
from sl_nerfstudio.scan.images import MAX_PIXELS
from sl_nerfstudio.scan.types import device_problems

# A device as a file describes it.

Role = Literal["camera", "projector"]
LENS_TERMS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")  # OpenCV's order


@dataclass(frozen=True)
class DeviceEntry:
    """One device in a file; its principal point already follows the convention of a scan."""

    label: str  # its name in the file, for messages
    role: Role | None  # None: the file does not say
    size: tuple[int, int] | None  # (w, h); None: the file does not say
    matrix: Float64[ndarray, "3 3"]
    distortion: tuple[float, ...]  # the first four to twelve of LENS_TERMS
    model: DeviceKind = "OPENCV"
    sigma_px: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of focal length, cx and cy; 0: the file states none


def camera_matrix(fl_x: float, fl_y: float, cx: float, cy: float) -> Float64[ndarray, "3 3"]:
    """Focal lengths and principal point as a matrix."""
    return np.array([[fl_x, 0, cx], [0, fl_y, cy], [0, 0, 1]], dtype=np.float64)


# Lens models with more terms than a scan has, reduced to k1, k2, p1, p2 where the difference is negligible.

LARGEST_MISS_PX = 0.1  # of the reduced model against the full one, anywhere in the image
_SAMPLES = 41  # per side of the image
_ITERATIONS = 50  # of undistortion


def reduce_distortion(
    coefficients: Sequence[float], matrix: Float64[ndarray, "3 3"], size: tuple[int, int]
) -> tuple[tuple[float, float, float, float], float]:
    """(k1, k2, p1, p2) nearest to OpenCV's LENS_TERMS, and the largest difference in pixels.

    `matrix` holds focal lengths and principal point; `size` is (w, h). Four coefficients stay as they are.
    """
    full = np.zeros(len(LENS_TERMS))
    full[: len(coefficients)] = coefficients
    if not full[4:].any():
        return (full[0], full[1], full[2], full[3]), 0.0
    x, y = _normalised_grid(full, matrix, size)
    xd, yd = _distort(x, y, full)
    rows_x, rows_y = lens_slopes(x, y)
    A = np.concatenate([matrix[0, 0] * rows_x, matrix[1, 1] * rows_y])
    b = np.concatenate([matrix[0, 0] * (xd - x), matrix[1, 1] * (yd - y)])
    k = np.linalg.lstsq(A, b, rcond=None)[0]
    miss = (A @ k - b).reshape(2, -1)
    return (float(k[0]), float(k[1]), float(k[2]), float(k[3])), float(np.hypot(*miss).max())


def lens_slopes(
    x: Float64[ndarray, "n"], y: Float64[ndarray, "n"]
) -> tuple[Float64[ndarray, "n 4"], Float64[ndarray, "n 4"]]:
    """Derivatives of distorted normalised coordinates, x and y, by k1, k2, p1, p2."""
    r2 = x * x + y * y
    rows_x = np.stack([x * r2, x * r2 * r2, 2 * x * y, r2 + 2 * x * x], -1)
    return rows_x, np.stack([y * r2, y * r2 * r2, r2 + 2 * y * y, 2 * x * y], -1)


def _normalised_grid(
    full: Float64[ndarray, "12"], matrix: Float64[ndarray, "3 3"], size: tuple[int, int]
) -> tuple[Float64[ndarray, "n"], Float64[ndarray, "n"]]:
    """Undistorted normalised coordinates of a grid of pixels, by fixed-point iteration."""
    u, v = np.meshgrid(np.linspace(0, size[0], _SAMPLES), np.linspace(0, size[1], _SAMPLES))
    xd = (u.reshape(-1) - matrix[0, 2]) / matrix[0, 0]
    yd = (v.reshape(-1) - matrix[1, 2]) / matrix[1, 1]
    x, y = xd, yd
    for _ in range(_ITERATIONS):
        ex, ey = _distort(x, y, full)
        x, y = x - (ex - xd), y - (ey - yd)
    return x, y


def _distort(
    x: Float64[ndarray, "n"], y: Float64[ndarray, "n"], full: Float64[ndarray, "12"]
) -> tuple[Float64[ndarray, "n"], Float64[ndarray, "n"]]:
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = full
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + r2 * s2)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + r2 * s4)
    return xd, yd


# Devices under the names of OpenCV and of other programs: the centre of the first pixel is (0, 0) there, so principal
# points get + 0.5.

_NAMED = 8  # names in a message
FIRST_CENTRE = 0.5  # of a pixel, added to what OpenCV measured


@dataclass(frozen=True)
class StoredPair:
    """The names under which a program stores a camera and a projector: matrix, lens, and sizes where it has them."""

    camera: tuple[str, str]
    projector: tuple[str, str]
    camera_size: tuple[str, ...] = ()  # width and height, or one name of both
    projector_size: tuple[str, ...] = ()
    by_cell: bool = False  # procam-calibration: sizes are (rows, columns), the projector is measured at whole cells


_PAIRS = (
    StoredPair(("M1", "D1"), ("M2", "D2")),  # OpenCV's stereo_calib
    StoredPair(("cameraMatrix1", "distCoeffs1"), ("cameraMatrix2", "distCoeffs2")),
    StoredPair(("K1", "D1"), ("K2", "D2")),
    StoredPair(("cam_K", "cam_kc"), ("proj_K", "proj_kc")),  # scan3d-capture (Moreno and Taubin), .yml
    StoredPair(("K_left", "kc_left"), ("K_right", "kc_right")),  # the same, .m
    StoredPair(("Kc", "kc"), ("Kp", "kp"), ("frameWidth", "frameHeight"), ("screenResX", "screenResY")),  # SLStudio
    StoredPair(("cam_int", "cam_dist"), ("proj_int", "proj_dist"), ("img_shape",), by_cell=True),
)
_MATRIX = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K")
_DISTORTION = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "D", "kc")
_SIZE = (("image_width", "image_height"), ("image_Width", "image_Height"), ("nx", "ny"))


def stored_entries(path: Path, stored: dict[str, Any], step: int) -> list[DeviceEntry]:
    """The camera of a calibration, or camera and projector of one. Raises FileError.

    `step` is the graycode_step of procam-calibration.
    """
    for pair in _PAIRS:
        (m1, d1), (m2, d2) = pair.camera, pair.projector
        if m1 in stored and m2 in stored:
            # procam-calibration measured at `step * index of the cell`, its first pixel; its middle is further.
            middle = FIRST_CENTRE + ((step - 1) / 2 if pair.by_cell else 0.0)
            labels = (m1, m2) if pair.by_cell else ("camera", "projector")
            camera, projector = (
                _stored_size(path, stored, names, pair.by_cell) for names in (pair.camera_size, pair.projector_size)
            )
            return [
                opencv_entry(path, labels[0], "camera", camera, stored[m1], stored.get(d1)),
                opencv_entry(path, labels[1], "projector", projector, stored[m2], stored.get(d2), middle),
            ]
    matrix = next((stored[key] for key in _MATRIX if key in stored), None)
    if matrix is None:
        raise FileError(
            path,
            f"contains no camera matrix (it has: {', '.join([*stored][:_NAMED]) or 'nothing'})",
            "this is no calibration, or one with other names",
            f"name the matrix {_MATRIX[0]} and the lens {_DISTORTION[0]}, as OpenCV's calibration program does",
        )
    size = next((size for names in _SIZE if (size := _stored_size(path, stored, names)) is not None), None)
    lens = next((stored[key] for key in _DISTORTION if key in stored), None)
    return [opencv_entry(path, path.name, None, size, matrix, lens)]


def _stored_size(
    path: Path, stored: dict[str, Any], names: Sequence[str], rows_first: bool = False
) -> tuple[int, int] | None:
    """The two numbers under the names; None where they are not stored, or 0, as SLStudio writes unknown sizes."""
    if not names or any(name not in stored for name in names):
        return None
    numbers = stored[names[0]] if len(names) == 1 else [stored[name] for name in names]
    if len(names) > 1 and all(number == 0 for number in numbers):
        return None
    first, second = image_size(path, numbers)
    return (second, first) if rows_first else (first, second)


def opencv_entry(
    path: Path,
    label: str,
    role: Role | None,
    size: tuple[int, int] | None,
    matrix: Any,
    lens: Any,
    offset: float = FIRST_CENTRE,
) -> DeviceEntry:
    """One device from its matrix and lens terms; `offset` is added to the principal point. Raises FileError."""
    K, k = _numbers(matrix), np.zeros(4) if lens is None else _numbers(lens)
    again = "calibrate again"
    if K is None or K.shape != (3, 3) or not np.isfinite(K).all():
        raise FileError(path, f"{label}: is no 3 x 3 matrix of numbers", "a failed calibration", again)
    if k is None or not np.isfinite(k).all():
        raise FileError(path, f"{label}: the lens terms are not numbers", "a failed calibration, or a slip", again)
    k = k.reshape(-1)
    if k.size not in (4, 5, 8, 12, 14):
        raise FileError(
            path,
            f"{label}: has {k.size} distortion coefficients, and OpenCV's models have 4, 5, 8, 12 or 14",
            "another program's lens model, or a slip",
            "calibrate with OpenCV's standard model",
        )
    if k[12:].any():
        raise FileError(
            path,
            f"{label}: the sensor is tilted (coefficients 13 and 14, tau x = {k[12]:.3g} and tau y = {k[13]:.3g}), "
            "which a scan's lens model cannot express",
            "calibrated with OpenCV's CALIB_TILTED_MODEL",
            "calibrate without this flag, or undistort the images",
        )
    _require_camera_matrix(path, label, K)
    K[:2, 2] += offset
    return DeviceEntry(label, role, size, K, tuple(k[: len(LENS_TERMS)].tolist()))


def image_size(path: Path, stored: Any) -> tuple[int, int]:
    """Width and height, or height and width, as stored. Raises FileError unless they are two whole numbers."""
    numbers = _numbers(stored)
    if numbers is None or numbers.size != 2 or not (numbers >= 1).all() or (numbers != np.floor(numbers)).any():
        raise FileError(
            path, "the size of the image is not two whole numbers", "the file was edited or is damaged",
            "give the size in pixels at which the device was calibrated",
        )  # fmt: skip
    first, second = numbers.reshape(-1).tolist()
    if first * second > MAX_PIXELS:
        raise FileError(path, f"the image would have {first * second:g} pixels", "a slip", "give the size in pixels")
    return int(first), int(second)


def _numbers(value: Any) -> Float64[ndarray, "..."] | None:
    """An array of numbers; None for texts and objects."""
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None


def _require_camera_matrix(path: Path, label: str, K: Float64[ndarray, "3 3"]) -> None:
    """Raises FileError unless `K` holds focal lengths, principal point, and nothing else."""
    if (K[2] != (0, 0, 1)).any() or K[1, 0] != 0:
        raise FileError(
            path,
            f"{label}: the camera matrix has {K[1, 0]:g} below its diagonal and the last row "
            f"{', '.join(f'{x:g}' for x in K[2])}",
            "it is transposed, scaled, or another kind of matrix",
            "give [fx 0 cx; 0 fy cy; 0 0 1] as OpenCV's calibration writes it",
        )
    if abs(K[0, 1]) * 2 * abs(K[1, 2]) > LARGEST_MISS_PX * abs(K[1, 1]):  # the skew's shift from top to bottom
        raise FileError(
            path,
            f"{label}: the camera matrix has a skew of {K[0, 1]:g}",
            "the axes of the sensor are not at right angles, or the matrix is that of another camera model",
            "calibrate without skew, as OpenCV does",
        )


# Plain JSON: `camera` and `projector` objects.
#
# The centre of the first pixel is (0.5, 0.5), or (0, 0) where the file says `"pixel_centre": 0`. The camera's keys may
# be at the top level, as in transforms.json. Several cameras are objects in `cameras`, by their names. `sigma`,
# optional in each device, holds 1 sigma of its `fl_x`, `cx` and `cy` in pixels.


def read_json_entries(path: Path) -> list[DeviceEntry]:
    """All devices in a file. Raises FileError."""
    document = read_document(path)
    faults = Faults()
    document_faults(document, path.name, faults)
    top = Fields(document, faults, path.name)
    offset = 0.5 - (top.read_number("pixel_centre", 0.5) or 0.0)
    found: list[DeviceEntry | None] = []
    if "camera" in document:
        found.append(_json_entry(top.read_section("camera"), "camera", offset))
    elif "cameras" in document:
        cameras = top.read_section("cameras")
        if cameras is not None:
            found += [_json_entry(cameras.read_section(name), "camera", offset, name) for name in cameras.record]
    elif "fl_x" in document:
        found.append(_json_entry(top, "camera", offset))
    if "projector" in document:
        found.append(_json_entry(top.read_section("projector"), "projector", offset))
    if faults.found:
        fault = faults.found[0]
        raise FileError(path, f"{fault.field}: {fault.problem}", fault.cause, fault.remedy)
    if not found:
        raise FileError(
            path,
            "describes neither a camera nor a projector",
            "another kind of JSON file",
            'give {"camera": {"w", "h", "fl_x", "fl_y", "cx", "cy", "k1", ..}, "projector": {..}}',
        )
    return [entry for entry in found if entry is not None]


def camera_names(path: Path) -> tuple[str, ...]:
    """Names of the cameras of a file with several, in its order; empty for a file with one or none."""
    if path.suffix.lower() != ".json":
        return ()
    cameras = read_document(path).get("cameras")
    return tuple(cameras) if isinstance(cameras, dict) else ()


def _json_entry(fields: Fields | None, role: Role, offset: float, name: str | None = None) -> DeviceEntry | None:
    """One device; None if a field is missing or wrong, which is then among the faults."""
    if fields is None:
        return None
    model = "OPENCV"
    for key in ("model", "camera_model"):
        if key in fields.record:
            model = fields.read_choice(key, ("OPENCV", "DOE"), "a model that a scan does not have")
    w, h = fields.read_count("w"), fields.read_count("h")
    numbers = [fields.read_number(key) for key in ("fl_x", "fl_y", "cx", "cy")]
    sigma = fields.read_section("sigma") if "sigma" in fields.record else None
    doubts = [0.0 if sigma is None else _at_least_zero(sigma, key) for key in ("fl_x", "cx", "cy")]
    lens = [fields.read_number(key, 0.0) for key in LENS_TERMS]
    if model is None or w is None or h is None or None in numbers or None in lens or None in doubts:
        return None
    fl_x, fl_y, cx, cy = (n or 0.0 for n in numbers)
    kind: DeviceKind = "DOE" if model == "DOE" else "OPENCV"
    matrix = camera_matrix(fl_x, fl_y, cx + offset, cy + offset)
    focal, x, y = (s or 0.0 for s in doubts)
    return DeviceEntry(name or role, role, (w, h), matrix, tuple(k or 0.0 for k in lens), kind, (focal, x, y))


def _at_least_zero(fields: Fields, key: str) -> float | None:
    """A standard deviation; 0 if it is not stated."""
    value = fields.read_number(key, 0.0)
    if value is not None and value < 0:
        fields.fault(key, f"is {value:g}", "a standard deviation is at least 0", "correct it, or leave sigma out")
        return None
    return value


# COLMAP's cameras.txt: the centre of the first pixel is (0.5, 0.5), as in a scan.

# COLMAP's models by their parameters; f stands for both focal lengths.
_MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
}


def read_colmap_entries(path: Path) -> list[DeviceEntry]:
    """All cameras in a file. Raises FileError."""
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
                path,
                f"line {number} describes no camera",
                "this is not COLMAP's cameras.txt, or it was edited",
                "each line must be: CAMERA_ID MODEL WIDTH HEIGHT PARAMS..",
            ) from error
        entries.append(_colmap_entry(path, f"camera {label}", model, (w, h), values))
    if not entries:
        raise FileError(path, "contains no camera", "an empty reconstruction", "export the model from COLMAP again")
    return entries


def _colmap_entry(path: Path, label: str, model: str, size: tuple[int, int], values: list[float]) -> DeviceEntry:
    names = _MODELS.get(model, "").split()
    if not names or len(names) != len(values):
        raise FileError(
            path,
            f"{label} has model {model} with {len(values)} parameters",
            "a lens model that a scan does not have" if not names else f"{model} has {len(names)} parameters",
            f"calibrate with one of {', '.join(_MODELS)}",
        )
    v = dict(zip(names, values, strict=True))
    matrix = camera_matrix(v.get("fx", v.get("f", 0.0)), v.get("fy", v.get("f", 0.0)), v["cx"], v["cy"])
    return DeviceEntry(label, None, size, matrix, tuple(v.get(key, 0.0) for key in LENS_TERMS))


_MISSING: dict[Role, str] = {
    "projector": "give its file with --projector-intrinsics, or find it from the captures: --estimate-projector",
    "camera": "give the camera's file",
}


def read_device_file(
    path: Path | str,
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
    path = Path(path)
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
    """Read a device's entry as it stands in the file; arguments and errors are those of `read_device_file`."""
    entries = [entry for entry in read_entries(path, procam_step) if name in ("", entry.label)]
    return _choose(path, entries, role, size)


def read_entries(path: Path, procam_step: int = 1) -> list[DeviceEntry]:
    """All devices in a file. Raises FileError for files of unknown format."""
    suffix = path.suffix.lower()
    if suffix == ".json":
        return read_json_entries(path)
    if suffix == ".txt":
        return read_colmap_entries(path)
    if suffix in STORED:
        return stored_entries(path, read_stored_values(path), procam_step)
    raise FileError(
        path,
        f"is of no known kind ({suffix or 'no ending'})",
        "known are .json, OpenCV's .yml .yaml .xml, COLMAP's cameras.txt, and the files of procam-calibration (.xml), "
        "scan3d-capture (.yml .m), SLStudio (.xml .m .slcalib) and MATLAB's calibration toolbox (.m)",
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
        beyond = {name: k for name, k in zip(LENS_TERMS[4:], entry.distortion[4:], strict=False) if k}
        thin = any(name.startswith("s") for name in beyond)
        raise FileError(
            path,
            f"{entry.label}: the lens model has terms beyond k1, k2, p1, p2 "
            f"({', '.join(f'{name} = {k:.3g}' for name, k in beyond.items())}), without which it is {miss:.2g} px off",
            "calibrated with k3 or the rational model" + (", and the thin-prism model" if thin else ""),
            "calibrate with k1, k2, p1, p2 alone (OpenCV: CALIB_FIX_K3, without CALIB_RATIONAL_MODEL and "
            "CALIB_THIN_PRISM_MODEL), or undistort the images",
        )
    K = entry.matrix
    fl_x, fl_y, cx, cy = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    return Device(w, h, fl_x, fl_y, cx, cy, k1, k2, p1, p2, entry.model)
