"""The content of a scan folder as frozen dataclasses; files are opened only by the `read_*` methods."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, UInt8, UInt16
from numpy import ndarray

from sl_nerfstudio.errors import Fault, ScanError
from sl_nerfstudio.geometry.devices import UNCHANGED, Device, Intrinsics, IntrinsicsChange, project, unproject
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity
from sl_nerfstudio.geometry.numerics import all_finite
from sl_nerfstudio.geometry.triangulation import pixel_rays, triangulate
from sl_nerfstudio.scan.coordinates import CoordinateFiles
from sl_nerfstudio.scan.document import TRANSFORMS, Faults, Fields, Problem
from sl_nerfstudio.scan.images import MAX_PIXELS, as_grey, read_image

# Cameras and projectors in transforms.json, and whether their numbers can be right.

REQUIRED = ("w", "h", "fl_x", "fl_y", "cx", "cy")
DISTORTION = ("k1", "k2", "p1", "p2")
CAMERA_KEYS = ("camera_model", *REQUIRED, *DISTORTION)
PROJECTOR_KEYS = ("model", *REQUIRED, *DISTORTION, "pattern_path")
_UNSUPPORTED = ("k3", "k4", "k5", "k6")
_NARROWEST, _WIDEST = 100.0, 0.1  # focal length in widths of the image: fields of view of 0.57 and 157 degrees
_ROUND_TRIP_PX = 1e-3
_LEAST_STRETCH, _MOST_STRETCH = 0.2, 2.0  # of distances from the principal point: fisheyes shrink, none doubles them


def read_device(fields: Fields, kind: str) -> Device | None:
    """The device that `fields` describes; `kind` is "camera" or "projector". None after adding faults."""
    key = "camera_model" if kind == "camera" else "model"
    choices = ("OPENCV",) if kind == "camera" else ("OPENCV", "DOE")
    model = fields.read_choice(key, choices, "it is a lens model that this format does not have")
    w, h = fields.read_count("w"), fields.read_count("h")
    values = {k: fields.read_number(k) for k in REQUIRED[2:]}
    values |= {k: fields.read_number(k, default=0.0) for k in DISTORTION}
    for k in _UNSUPPORTED:
        if fields.read_number(k, default=0.0):
            fields.fault(
                k, "is not 0", "the lens model has more terms than k1, k2, p1, p2",
                "calibrate with these four, or undistort the images",
            )  # fmt: skip
    numbers = {k: v for k, v in values.items() if v is not None}
    if model is None or w is None or h is None or len(numbers) != len(values):
        return None
    device = Device(w, h, *numbers.values(), model="DOE" if model == "DOE" else "OPENCV")
    problems = list(device_problems(device))
    for field, problem in problems:
        fields.faults.add(problem, fields.file, fields.frame, fields.prefix + field)
    return None if problems else device


def device_problems(device: Device) -> Iterator[tuple[str, Problem]]:
    """(key, problem) of every number of a device that cannot be right."""
    if device.w * device.h > MAX_PIXELS:
        problem = Problem(
            f"times h is {device.w * device.h} pixels", "a typing error", "give the size of the image in pixels"
        )
        yield "w", problem
        return
    focal_problems = list(_focal_problems(device))
    yield from focal_problems
    for key, size, centre in (("cx", device.w, device.cx), ("cy", device.h, device.cy)):
        if not -2 * size <= centre <= 3 * size:  # lens shift moves it outside the image, but not that far
            problem = Problem(
                f"is {centre:g}, far outside an image of {size} pixels",
                "the intrinsics are those of another resolution or in another unit",
                "give the principal point in pixels of this image",
            )
            yield key, problem
    if not focal_problems and any(getattr(device, k) for k in DISTORTION):
        yield from _distortion_problems(device)


def _focal_problems(device: Device) -> Iterator[tuple[str, Problem]]:
    for key, focal in (("fl_x", device.fl_x), ("fl_y", device.fl_y)):
        size = max(device.w, device.h)
        if focal <= 0:
            problem = Problem(
                f"is {focal:g}",
                "it was not filled in, or has the sign of OpenGL's projection",
                "give the focal length in pixels, a number greater than 0",
            )
            yield key, problem
        elif not _WIDEST * size <= focal <= _NARROWEST * size:
            problem = Problem(
                f"is {focal:g} pixels, which is impossible for an image of {size} pixels",
                "it was given in millimetres, as a fraction of the image, or for another resolution",
                "give the focal length in pixels of this image",
            )
            yield key, problem


def _distortion_problems(device: Device) -> Iterator[tuple[str, Problem]]:
    """Every pixel must return to its place when it is undistorted and distorted again, from a place not far away."""
    sides = (torch.linspace(0, size, 33, dtype=torch.float64) for size in (device.w, device.h))
    uv = torch.stack(torch.meshgrid(*sides, indexing="xy"), -1)
    # The distortion does not depend on the model (pinhole or DOE); a pinhole has no limit at 90 degrees.
    intrinsics = Intrinsics.of(replace(device, model="OPENCV"), torch.float64)
    directions = unproject(intrinsics, uv)
    remedy = "give k1, k2, p1, p2 as OpenCV defines them, fitted over the whole image"
    again, in_front = project(intrinsics, directions)
    if not (in_front.all() and ((again - uv).abs() < _ROUND_TRIP_PX).all()):
        problem = Problem(
            "and the other distortion terms fold the image over itself: two directions share a pixel",
            "the terms are of another model, in another order, or were fitted without points near the corners",
            remedy,
        )
        yield "k1", problem
        return
    straight = directions[..., :2] / -directions[..., 2:]
    bent = (uv - uv.new_tensor([device.cx, device.cy])) / uv.new_tensor([device.fl_x, device.fl_y])
    stretch = (bent.norm(dim=-1) / straight.norm(dim=-1)).nan_to_num(1.0)
    ends = float(stretch.min()), float(stretch.max())
    extreme = [value for value in ends if not _LEAST_STRETCH <= value <= _MOST_STRETCH]
    if extreme:
        problem = Problem(
            f"and the other distortion terms multiply distances from the principal point by {extreme[0]:.2g}",
            "a slip, terms of another model or in another order, or a fit to too few points; no lens does that",
            remedy,
        )
        yield "k1", problem


# The scan.

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

    def scaled(self, factor: float) -> "PoseSigma":
        """The same for a world that is `factor` times as large."""
        lengths = factor * self.camera_translation, factor * self.relative_translation
        return replace(self, camera_translation=lengths[0], relative_translation=lengths[1])


@dataclass(frozen=True)
class Frame:
    """One image with its camera, its projector and the coordinates decoded from it; paths are absolute.

    Both poses map device axes (+x right, +y up, looking along -z) to the world.
    """

    name: str
    camera: Device
    image_path: Path
    pattern_path: Path | None
    coords_files: CoordinateFiles | None
    mask_path: Path | None
    T_world_camera: Float64[ndarray, "4 4"]
    T_world_projector: Float64[ndarray, "4 4"]
    pose_sigma: PoseSigma | None = None
    color_path: Path | None = None  # the same view without the pattern

    @property
    def coords_paths(self) -> tuple[Path, ...]:
        """The files that hold the coordinates; none if they have not been decoded yet."""
        return () if self.coords_files is None else self.coords_files.paths

    def read_image(self) -> UInt8[ndarray, "h w *c"] | UInt16[ndarray, "h w *c"]:
        """The captured image, (h, w) grey or (h, w, 3) RGB, as stored. Raises UserError if unreadable."""
        return read_image(self.image_path)

    def read_color(self) -> UInt8[ndarray, "h w *c"] | UInt16[ndarray, "h w *c"] | None:
        """The view without the pattern, (h, w) grey or (h, w, 3) sRGB; None if it was not captured."""
        return None if self.color_path is None else read_image(self.color_path)

    def read_pattern(self) -> Float32[ndarray, "h w"]:
        """The normalised pattern image in [0, 1]; the captured image as grey where the scan has none."""
        return as_grey(read_image(self.pattern_path or self.image_path))

    def read_coords(self) -> Float32[ndarray, "h w 2"]:
        """Pattern coordinates (x_p, y_p) of each pixel, NaN where not decoded (everywhere if there is no file)."""
        if self.coords_files is None:
            return np.full((self.camera.h, self.camera.w, 2), np.nan, dtype=np.float32)
        return self.coords_files.read()

    def read_mask(self) -> Bool[ndarray, "h w"]:
        """Pixels where the pattern falls on the object: the mask file, else where coordinates were decoded."""
        if self.mask_path is not None:
            return read_image(self.mask_path) > 0
        return all_finite(self.read_coords())

    def read_masked_coords(self) -> Float32[ndarray, "h w 2"]:
        """Pattern coordinates where the mask allows them, NaN elsewhere."""
        return np.where(self.read_mask()[..., None], self.read_coords(), np.float32(np.nan))


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
    shrunk_by: int = 1  # squares of so many pixels of the photographs are one of the images

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

    def scaled(self, factor: float) -> "Scan":
        """The scan with all lengths of its poses and of their uncertainty multiplied by a factor."""
        grown, frames = Similarity.scaling(factor), []
        for frame in self.frames:
            poses = grown.poses(frame.T_world_camera), grown.poses(frame.T_world_projector)
            sigma = None if frame.pose_sigma is None else frame.pose_sigma.scaled(factor)
            frames.append(replace(frame, T_world_camera=poses[0], T_world_projector=poses[1], pose_sigma=sigma))
        return replace(self, frames=tuple(frames))

    def read_pattern(self) -> Float32[ndarray, "h w"]:
        """The projected pattern in [0, 1]."""
        return as_grey(read_image(self.pattern_path))


@dataclass(frozen=True)
class GroundTruth:
    """The true surface and the true poses of a scan; None for what the folder does not have."""

    mesh_path: Path | None
    poses: DevicePoses | None
    units: str | None  # of both; may be known where the scan's unit is not


# The key `scale` of transforms.json: whether lengths are true, and which length was measured.

FARTHEST = 1e12  # units from the origin: beyond, numbers of 16 digits do not hold a position exactly enough
_KEYS = ("known", "source", "baseline_of", "distance_between", "length")
_OLD_SOURCE = re.compile(r"baseline of frame (\d+)(?: \((.+)\))?")


def read_scale(top: Fields, frames: Sequence[str]) -> Scale | None:
    """The scale of a scan whose frames have these names; None after adding a fault.

    Scans written before `baseline_of` existed say "baseline of frame 3 (name)" or "baseline of frame 3" in `source`.
    The name in brackets is used if it is there, else the number, if the names of the frames do not contradict it.
    """
    section = top.read_section("scale")
    if section is None:
        return None
    section.check_spelling(_KEYS)
    known = section.read_flag("known")
    source = section.read_optional_text("source") if section.record.get("source") != "" else ""
    baseline_of = section.read_optional_text("baseline_of")
    bar = _read_bar(section)
    if known is None:
        return None
    if not known and (baseline_of is not None or bar is not None):
        section.fault(
            "known", "is false, although a known length is given", "the two keys contradict each other",
            "set known to true, or remove the length",
        )  # fmt: skip
        return None
    if baseline_of is not None and bar is not None:
        section.fault(
            "baseline_of", "is given together with distance_between", "two known lengths can contradict each other",
            "keep one of them",
        )  # fmt: skip
        return None
    if known and baseline_of is None and bar is None:
        baseline_of = _old_baseline(section, source or "", frames)
    return Scale(known, source or "", baseline_of, bar)


def check_scale_frames(scale: Scale, cameras: Mapping[str, Device | None], faults: Faults) -> None:
    """Add a fault for each frame and pixel of the known length that the scan does not have.

    `cameras` holds every frame's camera by name, None where it could not be read.
    """
    key = "scale.baseline_of" if scale.bar is None else "scale.distance_between"
    for name in scale.frames:
        if name not in cameras:
            problem = Problem(
                f"names frame {name!r}, which is not in the scan",
                "the frame was removed or renamed after the scan was made",
                f"put the frame back, or remove {key.removeprefix('scale.')}: then all lengths count alike",
            )
            faults.add(problem, TRANSFORMS, None, key)
    for end in () if scale.bar is None else scale.bar.ends:
        camera, (x, y) = cameras.get(end.frame), end.pixel
        if camera is not None and not (0 <= x < camera.w and 0 <= y < camera.h):
            problem = Problem(
                f"has the pixel ({x:g}, {y:g}), outside the {camera.w} x {camera.h} pixels of frame {end.frame!r}",
                "it was picked in an image of another size, or x and y are swapped",
                "give x and y of a pixel of this image",
            )
            faults.add(problem, TRANSFORMS, None, key)


def scale_record(scale: Scale) -> dict[str, Any]:
    """The value of `scale`."""
    record: dict[str, Any] = {"known": scale.known}
    if scale.source:
        record["source"] = scale.source
    if scale.baseline_of is not None:
        record["baseline_of"] = scale.baseline_of
    if scale.bar is not None:
        record["distance_between"] = [{"frame": e.frame, "pixel": [*map(float, e.pixel)]} for e in scale.bar.ends]
        record["length"] = float(scale.bar.length)
    return record


def _old_baseline(section: Fields, source: str, frames: Sequence[str]) -> str | None:
    """The frame of a scan that has only `source`; a name that is not among `frames` is returned all the same.

    A number alone says nothing once frames were removed. That shows in names which have numbers of their own.
    """
    found = _OLD_SOURCE.search(source)
    if found is None:
        return None
    number, name = int(found[1]), found[2]
    if name is not None and (name in frames or found[0] == source):
        return name
    own = [_last_number(frame) for frame in frames]
    if number < len(frames) and (own[number] == number or None in own):
        return frames[number]
    section.fault(
        "source",
        f"names frame number {number}, and it is not certain which one that is"
        if number < len(frames)
        else f"names frame number {number}, but there are only {len(frames)} frames",
        "frames were removed or renamed after the scan was made",
        "name the frame in baseline_of; if it was removed, take the sentence out: then all lengths count alike",
    )
    return None


def _last_number(name: str) -> int | None:
    """7 for frame_00007; None for a name that does not end in a number."""
    digits = re.search(r"[0-9]{1,9}$", name)
    return None if digits is None else int(digits[0])


def _read_bar(section: Fields) -> ScaleBar | None:
    """Read the scale bar; None where the scan has none, or after adding a fault."""
    ends, length = section.record.get("distance_between"), section.record.get("length")
    if ends is None and length is None:
        return None
    if ends is None or length is None:
        section.fault(
            "length" if length is None else "distance_between", "is missing",
            "distance_between and length are only valid together", "give both or neither",
        )  # fmt: skip
        return None
    number = section.read_number("length")
    if number is not None and not 0 < number <= FARTHEST:
        section.fault(
            "length", f"is {number:g}", "a typing error", f"give a length greater than 0, of {FARTHEST:g} units at most"
        )
        number = None
    if not isinstance(ends, list) or len(ends) != 2:
        section.fault("distance_between", "is not a list of two pixels", "wrong type", "see docs/scan-format.md")
        return None
    first, second = (_read_end(section, end, f"distance_between[{k}]") for k, end in enumerate(ends))
    if first is None or second is None or number is None:
        return None
    if first == second:
        section.fault("distance_between", "is twice the same pixel", "a copy", "give two different pixels")
        return None
    return ScaleBar((first, second), number)


def _read_end(section: Fields, end: Any, key: str) -> PickedPixel | None:
    if not isinstance(end, dict):
        section.fault(key, "is not an object { .. }", "wrong type", "see docs/scan-format.md")
        return None
    fields = Fields(end, section.faults, section.file, section.frame, f"{section.prefix}{key}.")
    fields.check_spelling(("frame", "pixel"))
    name, pixel = fields.read_text("frame"), fields.read_numbers("pixel", 2)
    return None if name is None or pixel is None else PickedPixel(name, (pixel[0], pixel[1]))


# The length of a scale bar, measured by triangulation.

NEAR_PX = 3.0  # how far from a picked pixel coordinates are used


def measured_length(scan: Scan, bar: ScaleBar, poses: DevicePoses) -> float:
    """Distance between the two picked surface points with these `poses` (of all frames), in the unit of the poses.

    Each point lies on the ray through its pixel, at the median depth of what was decoded within NEAR_PX of it.
    Reads the coordinates of the two frames. Raises ScanError where nothing near a pixel can be triangulated.
    """
    first, second = (_surface_point(scan, end, poses) for end in bar.ends)
    return float(np.linalg.norm(first - second))


def _surface_point(scan: Scan, end: PickedPixel, poses: DevicePoses) -> Float64[ndarray, "3"]:
    index = scan.index_of(end.frame)
    frame, coords = scan.frames[index], scan.frames[index].read_coords()
    row, column = np.nonzero(all_finite(coords))
    uv = np.stack([column, row], 1) + 0.5
    near = np.linalg.norm(uv - end.pixel, axis=1) < NEAR_PX
    camera, projector = Intrinsics.of(frame.camera, torch.float64), Intrinsics.of(scan.projector, torch.float64)
    T_camera, T_projector = (torch.from_numpy(T[index]) for T in (poses.T_world_camera, poses.T_world_projector))
    uv_projector = torch.from_numpy(coords[row[near], column[near]].astype(np.float64))
    points = triangulate(camera, T_camera, torch.from_numpy(uv[near]), projector, T_projector, uv_projector)
    depth = points.depth_camera.numpy()
    depth = depth[np.isfinite(depth)]
    if not len(depth):
        nothing = Fault(
            TRANSFORMS,
            end.frame,
            "scale.distance_between",
            f"has no decoded coordinates within {NEAR_PX:g} pixels of ({end.pixel[0]:g}, {end.pixel[1]:g})",
            "the pattern was not decoded there",
            "pick a pixel on the object where coordinates were decoded",
        )
        raise ScanError([nothing], str(scan.root))
    origin, direction = pixel_rays(camera, T_camera, torch.tensor([end.pixel], dtype=torch.float64))
    return (origin + float(np.median(depth)) * direction)[0].numpy()
