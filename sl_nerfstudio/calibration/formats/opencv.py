"""OpenCV's .yml, .yaml and .xml: the centre of the first pixel is (0, 0), so principal points get + 0.5."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sl_nerfstudio.calibration.formats.entry import DeviceEntry, Role
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.scan.file_error import FileError, read_bytes

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
            f"contains no camera matrix (it has: {', '.join(stored) or 'nothing'})",
            "this is no calibration, or one with other names",
            f"name the matrix {_MATRIX[0]} and the lens {_DISTORTION[0]}, as OpenCV's calibration program does",
        )
    size = next(((int(stored[w]), int(stored[h])) for w, h in _SIZE if w in stored and h in stored), None)
    lens = next((stored[key] for key in _DISTORTION if key in stored), None)
    return [opencv_entry(path, path.name, None, size, matrix, lens, FIRST_CENTRE)]


def opencv_entry(
    path: Path, label: str, role: Role | None, size: tuple[int, int] | None, matrix: Any, lens: Any, offset: float
) -> DeviceEntry:
    """One device from its matrix and lens terms; `offset` is added to the principal point. Raises FileError."""
    K = np.array(matrix, dtype=np.float64)
    k: Sequence[float] = [0.0] * 4 if lens is None else np.array(lens, dtype=np.float64).reshape(-1).tolist()
    if K.shape != (3, 3) or not np.isfinite(K).all() or not np.isfinite(k).all():
        raise FileError(path, f"{label}: is no 3 x 3 matrix of numbers", "a failed calibration", "calibrate again")
    if len(k) not in (4, 5, 8):
        raise FileError(
            path,
            f"{label}: has {len(k)} distortion coefficients",
            "a fisheye, thin-prism or tilted model",
            "calibrate with OpenCV's standard model",
        )
    K[:2, 2] += offset
    return DeviceEntry(label, role, size, K, tuple(k))


def read_file_storage(path: Path) -> dict[str, Any]:
    """The top level of an OpenCV file: matrices, numbers, texts, lists of numbers. Raises FileError."""
    import cv2

    text = read_bytes(path).decode("utf-8", "replace")
    storage = cv2.FileStorage()
    try:
        opened = storage.open(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root = storage.root() if opened else None
        keys = root.keys() if root is not None and root.isMap() else []
        return {key: _value(storage.getNode(key)) for key in keys}
    except (cv2.error, SystemError, UserError) as error:
        raise FileError(
            path,
            "cannot be read as an OpenCV file",
            "it is damaged, or was written by another program (OpenCV's YAML starts with %YAML:1.0)",
            "write it again with cv2.FileStorage, or give plain JSON",
        ) from error
    finally:
        storage.release()


def _value(node: Any) -> Any:
    if node.isReal() or node.isInt():
        return node.real()
    if node.isString():
        return node.string()
    if node.isSeq():
        return [node.at(k).real() for k in range(node.size())]
    return node.mat()
