"""A device as a file describes it."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import DeviceKind

Role = Literal["camera", "projector"]
LENS_TERMS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # OpenCV's order


@dataclass(frozen=True)
class DeviceEntry:
    """One device in a file; its principal point already follows the convention of a scan."""

    label: str  # its name in the file, for messages
    role: Role | None  # None: the file does not say
    size: tuple[int, int] | None  # (w, h); None: the file does not say
    matrix: Float64[ndarray, "3 3"]
    distortion: tuple[float, ...]  # the first four to eight of LENS_TERMS
    model: DeviceKind = "OPENCV"
    sigma_px: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of focal length, cx and cy; 0: the file states none


def camera_matrix(fl_x: float, fl_y: float, cx: float, cy: float) -> Float64[ndarray, "3 3"]:
    """Focal lengths and principal point as a matrix."""
    return np.array([[fl_x, 0, cx], [0, fl_y, cy], [0, 0, 1]], dtype=np.float64)
