"""What a scan folder holds, as frozen dataclasses; files are opened only by the `read_*` methods."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8, UInt16
from numpy import ndarray

from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.devices import UNCHANGED, Device, IntrinsicsChange
from sl_nerfstudio.scan.coordinates import read_coords
from sl_nerfstudio.scan.images import as_grey, read_image

FORMAT = 1  # of the scan folder

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "arbitrary": None}
"""Units of length that a scan may use, and their length in metres (None: unknown)."""


@dataclass(frozen=True)
class PickedPixel:
    """A pixel of one frame: `pixel` is (x, y), and the centre of the first pixel is (0.5, 0.5)."""

    frame: str
    pixel: tuple[float, float]


@dataclass(frozen=True)
class ScaleBar:
    """The true distance, in the scan's unit, between the surface points seen at two pixels."""

    ends: tuple[PickedPixel, PickedPixel]
    length: float


@dataclass(frozen=True)
class Scale:
    """Whether the lengths in a scan are true, and which length was measured.

    At most one of `baseline_of` and `bar` is set. If neither is, all lengths of the starting poses count alike.
    """

    known: bool
    source: str = ""  # for people: how the scale is known
    baseline_of: str | None = None  # name of the frame whose distance from camera to projector is true
    bar: ScaleBar | None = None

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the frames in which the known length was measured."""
        if self.baseline_of is not None:
            return (self.baseline_of,)
        return () if self.bar is None else tuple(end.frame for end in self.bar.ends)


@dataclass(frozen=True)
class PoseSigma:
    """One standard deviation of the starting poses; translations in the scan's unit.

    `camera_*` is the frame as a whole (camera and projector together) in the world, rotating about the middle of the
    scene; `relative_*` is the projector relative to the camera of the same frame.
    """

    camera_translation: float
    camera_rotation_deg: float
    relative_translation: float
    relative_rotation_deg: float


@dataclass(frozen=True)
class Frame:
    """One image with its camera, its projector and the coordinates decoded from it; paths are absolute.

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
    color_path: Path | None = None  # the same view without the pattern

    def read_image(self) -> UInt8[ndarray, "h w *c"] | UInt16[ndarray, "h w *c"]:
        """The captured image, (h, w) grey or (h, w, 3) RGB, as stored. Raises UserError if unreadable."""
        return read_image(self.image_path)

    def read_color(self) -> UInt8[ndarray, "h w *c"] | UInt16[ndarray, "h w *c"] | None:
        """The same view without the pattern, (h, w) grey or (h, w, 3) sRGB; None if it was not captured."""
        return None if self.color_path is None else read_image(self.color_path)

    def read_pattern(self) -> Float32[ndarray, "h w"]:
        """The normalised pattern image in [0, 1]; the captured image as grey where the scan has none."""
        return as_grey(read_image(self.pattern_path or self.image_path))

    def read_coords(self) -> Float32[ndarray, "h w 2"]:
        """Pattern coordinates (x_p, y_p) of each pixel, NaN where not decoded (everywhere if there is no file)."""
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
    intrinsics_change: IntrinsicsChange = UNCHANGED  # of these devices relative to those in transforms.json

    @property
    def poses(self) -> DevicePoses:
        """Starting poses, in the order of the frames."""
        return DevicePoses(
            np.stack([frame.T_world_camera for frame in self.frames]),
            np.stack([frame.T_world_projector for frame in self.frames]),
        )

    def index_of(self, name: str) -> int:
        """Position of the frame with this name. Raises ValueError if there is none."""
        return [frame.name for frame in self.frames].index(name)

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


@dataclass(frozen=True)
class GroundTruth:
    """The true surface and the true poses of a scan; None for what the folder does not have."""

    mesh_path: Path | None
    poses: DevicePoses | None
    units: str | None  # of both; may be known where the scan's unit is not
