"""OpenCV's .yml, .yaml and .xml: the centre of the first pixel is (0, 0), so principal points get + 0.5."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.calibration.distortion_fit import LARGEST_MISS_PX
from sl_nerfstudio.calibration.formats.entry import DeviceEntry, Role
from sl_nerfstudio.scan.file_error import FileError
from sl_nerfstudio.scan.images import MAX_PIXELS

_NAMED = 8  # names in a message
FIRST_CENTRE = 0.5  # of a pixel, added to what OpenCV measured
_MATRIX = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K")
_DISTORTION = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "D")
_SIZE = (("image_width", "image_height"), ("image_Width", "image_Height"))
_PAIRS = (("M1", "D1", "M2", "D2"), ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2"))


def opencv_entries(path: Path, stored: dict[str, Any]) -> list[DeviceEntry]:
    """The camera of a calibration, or camera and projector of a stereo calibration. Raises FileError."""
    for m1, d1, m2, d2 in _PAIRS:
        if m1 in stored and m2 in stored:
            return [
                opencv_entry(path, "camera", "camera", None, stored[m1], stored.get(d1), FIRST_CENTRE),
                opencv_entry(path, "projector", "projector", None, stored[m2], stored.get(d2), FIRST_CENTRE),
            ]
    matrix = next((stored[key] for key in _MATRIX if key in stored), None)
    if matrix is None:
        raise FileError(
            path,
            f"contains no camera matrix (it has: {', '.join([*stored][:_NAMED]) or 'nothing'})",
            "this is no calibration, or one with other names",
            f"name the matrix {_MATRIX[0]} and the lens {_DISTORTION[0]}, as OpenCV's calibration program does",
        )
    size = next((image_size(path, [stored[w], stored[h]]) for w, h in _SIZE if w in stored and h in stored), None)
    lens = next((stored[key] for key in _DISTORTION if key in stored), None)
    return [opencv_entry(path, path.name, None, size, matrix, lens, FIRST_CENTRE)]


def opencv_entry(
    path: Path, label: str, role: Role | None, size: tuple[int, int] | None, matrix: Any, lens: Any, offset: float
) -> DeviceEntry:
    """One device from its matrix and lens terms; `offset` is added to the principal point. Raises FileError."""
    K, k = _numbers(matrix), np.zeros(4) if lens is None else _numbers(lens)
    if K is None or K.shape != (3, 3) or not np.isfinite(K).all():
        raise FileError(path, f"{label}: is no 3 x 3 matrix of numbers", "a failed calibration", "calibrate again")
    if k is None or not np.isfinite(k).all():
        raise FileError(
            path, f"{label}: the lens terms are not numbers", "a failed calibration, or a slip", "calibrate again"
        )
    if k.size not in (4, 5, 8):
        raise FileError(
            path,
            f"{label}: has {k.size} distortion coefficients",
            "a fisheye, thin-prism or tilted model",
            "calibrate with OpenCV's standard model",
        )
    _require_camera_matrix(path, label, K)
    K[:2, 2] += offset
    return DeviceEntry(label, role, size, K, tuple(k.reshape(-1).tolist()))


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
