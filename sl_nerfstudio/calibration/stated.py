"""Stated intrinsics: their uncertainty in a file, and the focal length that a camera wrote into its photographs."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.calibration.formats import Role, chosen_entry
from sl_nerfstudio.geometry.devices import Device, IntrinsicsChange
from sl_nerfstudio.scan.document import FileError
from sl_nerfstudio.scan.images import exif_numbers

# Uncertainty in a file; sl-calibrate's has it.

CERTAIN = (0.0, 0.0, 0.0)
Shares = tuple[float, float, float]


@dataclass(frozen=True)
class StatedSigma:
    """1 sigma of focal length and principal point x, y of both devices, as shares of their focal lengths.

    0 where nothing is stated: such values count as certain.
    """

    camera: Shares = CERTAIN
    projector: Shares = CERTAIN

    @property
    def either(self) -> Float64[ndarray, "3 3"]:
        """Covariance of what a wrong value of either device looks like in one of them.

        A focal length of the camera that is one per cent off looks much like one of the projector, and a principal
        point that lies beside its place is a turn of the device.
        """
        return np.diag(np.square(self.camera) + np.square(self.projector))

    @property
    def both(self) -> Float64[ndarray, "6"]:
        """1 sigma of the six values, the camera's first."""
        return np.array([*self.camera, *self.projector])


def read_stated_sigma(
    path: Path | None, role: Role, size: tuple[int, int], procam_step: int = 1, name: str = ""
) -> Shares:
    """Read the uncertainty that a file states for a device; `CERTAIN` if it states none, or for no file."""
    if path is None:
        return CERTAIN
    entry = chosen_entry(path, role, size, procam_step, name)
    focal = float(entry.matrix[0, 0])
    a, b, c = entry.sigma_px
    return a / focal, b / focal, c / focal


# A change of intrinsics in the units that people think in.


def describe_change(
    change: IntrinsicsChange, sigma: IntrinsicsChange, cameras: Sequence[Device], projector: Device
) -> list[str]:
    """One line a device: focal length in percent, principal point in pixels, each with 1 sigma."""
    lines = []
    camera_focal = median(camera.fl_x for camera in cameras)
    for name, focal, value, error in (
        ("camera", camera_focal, change.camera, sigma.camera),
        ("projector", projector.fl_x, change.projector, sigma.projector),
    ):
        lines.append(
            f"{name}: focal length {100 * value.focal:+.2f} ± {100 * error.focal:.2f} %, principal point "
            f"({focal * value.x:+.1f} ± {focal * error.x:.1f}, {focal * value.y:+.1f} ± {focal * error.y:.1f}) px"
        )
    return lines


# A start for the camera from EXIF data (EXIF 2.32, JEITA CP-3451).

_FOCAL_MM, _FOCAL_35 = 0x920A, 0xA405  # FocalLength, FocalLengthIn35mmFilm
_PLANE_X, _PLANE_UNIT, _STORED_W, _STORED_H = 0xA20E, 0xA210, 0xA002, 0xA003  # sensor pixels per unit, size as taken
_ZOOM = 0xA404  # DigitalZoomRatio
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0}
_DIAGONAL_35 = math.hypot(36, 24)  # mm
_SIGMA_NOMINAL = 0.03  # focal lengths are nominal: rounded by the maker, and they change with the distance of focus
_SIGMA_35_MM = 0.3  # rounding to whole millimetres
_SIGMA_ZOOM = 0.1  # programs differ in whether the stated focal length includes a digital zoom


@dataclass(frozen=True)
class CameraStart:
    """A camera whose focal length is roughly known; its principal point is in the middle, its lens undistorted."""

    camera: Device
    sigma: float  # 1 sigma of the focal length, share of it
    source: str  # what the camera wrote, for people


def camera_from_exif(paths: Sequence[Path], size: tuple[int, int]) -> CameraStart:
    """The camera of photographs of `size` (w, h), turned as their tags say.

    Raises FileError if they do not state a focal length, or state several.
    """
    numbers = [exif_numbers(path) for path in paths]
    stated = {(n.get(_FOCAL_MM), n.get(_FOCAL_35), n.get(_ZOOM, 0.0)) for n in numbers}
    if len(stated) > 1:
        listed = sorted({f"{n.get(_FOCAL_MM) or n.get(_FOCAL_35) or 0:g} mm" for n in numbers})
        raise FileError(
            paths[0].parent,
            f"holds photographs with several focal lengths ({', '.join(listed[:4])})",
            "the zoom was moved, or the phone changed lenses",
            "capture again with one lens and one zoom; intrinsics are valid for one only",
        )
    found = _focal(numbers[0], size)
    if found is None:
        raise FileError(
            paths[0],
            "does not say with which focal length it was taken, and no file gives the camera's intrinsics",
            "its EXIF data were removed by a program, or the camera writes none",
            "give --intrinsics: sl-calibrate makes such a file from photographs of a board, of the camera alone with "
            "--camera-only; the projector can be found from the captures, with --estimate-projector",
        )
    focal, sigma, source = found
    w, h = size
    return CameraStart(Device(w, h, focal, focal, w / 2, h / 2), sigma, source)


def _focal(numbers: dict[int, float], size: tuple[int, int]) -> tuple[float, float, str] | None:
    """Focal length in pixels, its relative sigma, and where it is from; None if nothing is stated."""
    zoomed = numbers.get(_ZOOM, 0.0) > 1
    extra = _SIGMA_ZOOM if zoomed else 0.0
    more = f", digital zoom {numbers[_ZOOM]:g}" if zoomed else ""
    film = numbers.get(_FOCAL_35, 0.0)
    if film > 0:
        sigma = math.hypot(_SIGMA_NOMINAL, _SIGMA_35_MM / film, extra)
        return film * math.hypot(*size) / _DIAGONAL_35, sigma, f"{film:g} mm (35 mm equivalent){more}"
    focal, per_unit = numbers.get(_FOCAL_MM, 0.0), numbers.get(_PLANE_X, 0.0)
    unit = _UNIT_MM.get(int(numbers.get(_PLANE_UNIT, 2)))
    stored = max(numbers.get(_STORED_W, 0.0), numbers.get(_STORED_H, 0.0))
    if focal <= 0 or per_unit <= 0 or unit is None:
        return None
    scale = max(size) / stored if stored > 0 else 1.0
    return focal * per_unit / unit * scale, math.hypot(_SIGMA_NOMINAL, extra), f"{focal:g} mm{more}"
