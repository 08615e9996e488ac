"""The axes and the unit of the scan, by given poses, a known length or neither, and where frames are in them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from numpy import ndarray

from sl_nerfstudio.bundle_adjustment.registered_frames import AdjustedFrames
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.triangulation import triangulate_pixels
from sl_nerfstudio.object_separation.separate import Part
from sl_nerfstudio.processing.frames import FrameStageResult, clouds_of
from sl_nerfstudio.processing.inputs import GivenPoses, align_to
from sl_nerfstudio.registration.result import KnownLength, Registration, scale_to
from sl_nerfstudio.registration.surfaces import FrameCloud, reliable_points
from sl_nerfstudio.scan.types import UNITS, PickedPixel, Scale, ScaleBar


@dataclass(frozen=True)
class ScanPoses:
    """Poses of all frames in the axes and the unit of the scan."""

    adjusted: AdjustedFrames
    units: str
    scale: Scale


def find_scan_poses(
    clouds: Sequence[FrameCloud],
    registration: Registration,
    adjusted: AdjustedFrames,
    known: KnownLength | None,
    given: GivenPoses | None,
) -> ScanPoses:
    """The adjusted poses in the axes and the unit that are known.

    A known length overrules the unit of given poses. Raises UserError if it is in a frame that was not registered.
    """
    units, scale = "arbitrary", Scale(False)
    if given is not None:
        adjusted = adjusted.mapped(align_to(given, adjusted.poses.T_world_camera, registration.registered))
        units = given.units
        scale = scale if units == "arbitrary" else Scale(True, "given camera poses")
    if known is not None:
        devices = adjusted.poses
        factor = scale_to(known, known.unit, clouds, devices.T_world_camera, devices.T_world_projector)
        adjusted, units, scale = adjusted.scaled(factor), known.unit, stated_scale(known)
    return ScanPoses(adjusted, units, scale)


def require_known_frames(known: KnownLength, clouds: Sequence[FrameCloud]) -> None:
    """Raise UserError if a frame of the known length has no cloud."""
    lost = set(known.frames) - {cloud.name for cloud in clouds}
    if lost:
        raise UserError(
            f"--known-length: {sorted(lost)[0]} could not be used, so no length in it can be measured\n"
            "    cause:  it could not be decoded or calibrated\n    remedy: give a length in another frame"
        )


def stated_scale(known: KnownLength) -> Scale:
    """The known length as the scan states it; its frames are given by name."""
    if not known.pixels:
        return Scale(True, known.source, baseline_of=known.frames[0])
    first, second = (PickedPixel(*end) for end in zip(known.frames, known.pixels, strict=True))
    length = known.metres / (UNITS[known.unit] or 1.0)
    return Scale(True, known.source, bar=ScaleBar((first, second), length))


# Where the frames are and what they see, for the 3D view of the report.

MOST_POINTS = 250_000  # of all frames together
_MOST_OF_A_FRAME = 10_000


@dataclass(frozen=True)
class PlacedFrame:
    """A frame in the axes and the unit of its group."""

    name: str
    camera: Device
    projector: Device
    T_world_camera: Float64[ndarray, "4 4"]
    T_world_projector: Float64[ndarray, "4 4"]
    points: Float32[ndarray, "n 3"]  # some of the surface that it sees
    uv_camera: Float64[ndarray, "n 2"]  # the pixels that see them


@dataclass(frozen=True)
class PlacedGroup:
    """Frames that are connected with each other: the scan, another component, or a frame by itself."""

    component: int  # 0: the scan; 1, 2, ...: others, each in its own axes and unit; -1: a frame by itself
    frames: tuple[PlacedFrame, ...]

    def only_object(self, parts: dict[str, UInt8[ndarray, "h w"]]) -> "PlacedGroup":
        """Leave out the points of surroundings. `parts` is what each pixel shows (`Part`), by the frame's name."""
        frames = []
        for frame in self.frames:
            if frame.name in parts:
                column, row = np.floor(frame.uv_camera).astype(np.int64).T
                keep = parts[frame.name][row, column] == Part.OBJECT
                frame = replace(frame, points=frame.points[keep], uv_camera=frame.uv_camera[keep])
            frames.append(frame)
        return replace(self, frames=tuple(frames))


def place_frames(
    results: Sequence[FrameStageResult], registration: Registration | None, poses: ScanPoses | None
) -> tuple[PlacedGroup, ...]:
    """The scan first, then the other components, then single frames that were decoded and calibrated."""
    clouds = clouds_of(results)
    most = min(_MOST_OF_A_FRAME, MOST_POINTS // max(len(clouds), 1))
    groups = [g for g in _groups(clouds, registration, poses, most) if g.frames]
    placed = {frame.name for group in groups for frame in group.frames}
    alone = [c for c in clouds if c.name not in placed]
    return (*groups, *(PlacedGroup(-1, (_placed(c, np.eye(4), 1.0, most),)) for c in alone))


def _groups(
    clouds: Sequence[FrameCloud], registration: Registration | None, poses: ScanPoses | None, most: int
) -> Iterator[PlacedGroup]:
    if registration is None:
        return
    inside = registration.registered & (poses is not None)
    if poses is not None:
        T = poses.adjusted.poses
        chosen = np.flatnonzero(inside).tolist()
        placed = (_at(clouds[k], T.T_world_camera[k], T.T_world_projector[k], most) for k in chosen)
        yield PlacedGroup(0, tuple(placed))
    by_name = {cloud.name: k for k, cloud in enumerate(clouds)}
    for separate in registration.separate:
        left = [(by_name[name], i) for i, name in enumerate(separate.frames) if not inside[by_name[name]]]
        frames = [_placed(clouds[k], separate.T_world_camera[i], float(separate.baseline[i]), most) for k, i in left]
        if len(frames) > 1:  # of the others, one alone is no component
            yield PlacedGroup(int(registration.component[left[0][0]]), tuple(frames))


def _placed(cloud: FrameCloud, T_world_camera: Float64[ndarray, "4 4"], baseline: float, most: int) -> PlacedFrame:
    """A frame with its own relative pose, and a baseline of some length."""
    T = cloud.pose.T_camera_projector.copy()
    T[:3, 3] *= baseline / np.linalg.norm(T[:3, 3])
    return _at(cloud, T_world_camera, T_world_camera @ T, most)


def _at(
    cloud: FrameCloud, T_world_camera: Float64[ndarray, "4 4"], T_world_projector: Float64[ndarray, "4 4"], most: int
) -> PlacedFrame:
    """A frame with points triangulated at these poses; those with by far the largest uncertainty are left out."""
    good = np.flatnonzero(reliable_points(cloud))
    uv = cloud.uv_camera[good[np.linspace(0, len(good) - 1, min(most, len(good))).astype(np.int64)]]
    column, row = np.floor(uv).astype(np.int64).T
    devices = cloud.camera, cloud.projector, T_world_camera, T_world_projector
    found = triangulate_pixels(*devices, cloud.coords, row, column)
    seen = (found.depth_camera > 0).numpy()
    points = found.p_world.numpy()[seen].astype(np.float32)
    return PlacedFrame(cloud.name, cloud.camera, cloud.projector, T_world_camera, T_world_projector, points, uv[seen])
