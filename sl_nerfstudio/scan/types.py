"""What a scan folder holds, as frozen dataclasses; files are opened only by the `read_*` methods."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8, UInt16
from numpy import ndarray

from sl_nerfstudio.geometry.devices import UNCHANGED, Device, IntrinsicsChange
from sl_nerfstudio.scan.coordinates import read_coords
from sl_nerfstudio.scan.images import as_grey, read_image

FORMAT = 1  # of the scan folder

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "arbitrary": None}
"""Units of length a scan may be given in, and their length in metres (None: not known)."""


@dataclass(frozen=True)
class Scale:
    """Whether the lengths of a scan are true ones, and by what they are known."""

    known: bool
    source: str = ""


@dataclass(frozen=True)
class PoseSigma:
    """One standard deviation of the starting poses; translations in the scan's unit.

    `camera_*` is the frame as a whole (camera and projector together) in the world;
    `relative_*` is the projector against the camera of the same frame.
    """

    camera_translation: float
    camera_rotation_deg: float
    relative_translation: float
    relative_rotation_deg: float


@dataclass(frozen=True)
class Frame:
    """One image with its camera, its projector and what was decoded from it; paths are absolute.

    Both poses map device axes (+x right, +y up, looking along -z) to the world.
    """

    name: str
    camera: Device
    image_path: Path
    pattern_path: Path | None
    coords_path: Path | None
    mask_path: Path | None
    T_world_camera: Float64[ndarray, "4 4"]
    T_world_projector: Float64[ndarray, "4 4"]
    pose_sigma: PoseSigma | None = None

    def read_image(self) -> UInt8[ndarray, "h w *c"] | UInt16[ndarray, "h w *c"]:
        """The captured image, (h, w) grey or (h, w, 3) RGB, as stored. Raises UserError if unreadable."""
        return read_image(self.image_path)

    def read_pattern(self) -> Float32[ndarray, "h w"]:
        """The normalised pattern image in [0, 1]; the captured image as grey where the scan has none."""
        return as_grey(read_image(self.pattern_path or self.image_path))

    def read_coords(self) -> Float32[ndarray, "h w 2"]:
        """Pattern coordinates (x_p, y_p) of each pixel, NaN where not decoded (everywhere without a file)."""
        if self.coords_path is None:
            return np.full((self.camera.h, self.camera.w, 2), np.nan, dtype=np.float32)
        return read_coords(self.coords_path)

    def read_mask(self) -> Bool[ndarray, "h w"]:
        """Where the pattern falls on the object: the mask file, else where coordinates were decoded."""
        if self.mask_path is not None:
            return read_image(self.mask_path) > 0
        return np.isfinite(self.read_coords()).all(-1)


@dataclass(frozen=True)
class Scan:
    """A scan folder: one projector with its pattern, and the frames."""

    root: Path
    units: str
    scale: Scale
    projector: Device
    pattern_path: Path
    frames: tuple[Frame, ...]
    intrinsics_change: IntrinsicsChange = UNCHANGED  # of the devices here against those of transforms.json

    def with_intrinsics_change(self, change: IntrinsicsChange) -> "Scan":
        """The scan with other focal lengths and principal points. Raises ValueError if they were changed before."""
        if self.intrinsics_change:
            raise ValueError("the intrinsics of this scan were changed before")
        return replace(
            self,
            projector=change.projector.applied(self.projector),
            frames=tuple(replace(frame, camera=change.camera.applied(frame.camera)) for frame in self.frames),
            intrinsics_change=change,
        )

    def read_pattern(self) -> Float32[ndarray, "h w"]:
        """The projected pattern in [0, 1]."""
        return as_grey(read_image(self.pattern_path))

    @property
    def T_world_camera(self) -> Float64[ndarray, "n 4 4"]:
        """Starting poses of the cameras, in the order of the frames."""
        return np.stack([frame.T_world_camera for frame in self.frames])

    @property
    def T_world_projector(self) -> Float64[ndarray, "n 4 4"]:
        """Starting poses of the projectors, in the order of the frames."""
        return np.stack([frame.T_world_projector for frame in self.frames])


@dataclass(frozen=True)
class GroundTruth:
    """What is truly known of a scan: each part None where the folder lacks it."""

    mesh_path: Path | None
    T_world_camera: Float64[ndarray, "n 4 4"] | None
    T_world_projector: Float64[ndarray, "n 4 4"] | None
