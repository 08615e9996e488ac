"""What registration found: poses, the pairs that support them, frames that were left out, and what is uncertain."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.registration.surfaces import FrameCloud
from sl_nerfstudio.relative_pose.epipolar import directions
from sl_nerfstudio.relative_pose.intrinsics import camera_depth
from sl_nerfstudio.scan.lengths import METRES, parse_length
from sl_nerfstudio.scan.types import UNITS


@dataclass(frozen=True)
class Edge:
    """Two frames that were registered with each other."""

    frames: tuple[str, str]
    R_second_first: Float64[ndarray, "3 3"]  # between their cameras, as the pair says it
    overlap: float  # share of the points that agree
    fitness: float  # share of those that could be judged
    used: bool  # False: inconsistent with the other pairs
    undecided: bool  # a clearly different similarity fits nearly as well
    rotation_sigma_deg: float  # standard deviation of the rotation that this pair determines least
    by_tone: bool = False  # surfaces alone would let the frames slip: their tones hold them


@dataclass(frozen=True)
class SurfaceDisagrees:
    """A frame was left out because its surface does not agree with that of the other frames."""

    frame: str
    fitness: float  # of its points that other frames can judge, the share that agrees


@dataclass(frozen=True)
class NoCommonSurface:
    """A frame was left out because no other frame shares any surface with it."""

    frame: str


@dataclass(frozen=True)
class SeparateComponent:
    """A frame was left out because it, or its component, is not connected to the largest one with certainty."""

    frame: str
    component: tuple[str, ...]  # all frames of its component
    slips: bool  # every pair that connects it may slip along the surface
    partner: str | None  # the frame of the largest component with which it shares most; None: none


@dataclass(frozen=True)
class PoorPair:
    """A frame was left out because even its best pair overlaps or agrees too little."""

    frame: str
    partner: str
    overlap: float  # share of the points that agree
    fitness: float  # share of those that could be judged
    log_odds: float  # that they have a surface in common, nats
    least_odds: float


@dataclass(frozen=True)
class OpenPlace:
    """A frame was left out because it is nearly as likely to belong elsewhere."""

    frame: str
    group: tuple[str, ...]  # frames that would move with it
    turn_deg: float  # by which they may be turned against the rest
    log_odds: float  # of the likelier place, nats
    partner: str | None  # the frame of the rest with which it shares most


@dataclass(frozen=True)
class CoordinatesDisagree:
    """A frame was left out after the joint adjustment: its coordinates contradict those of the other frames."""

    frame: str
    group: tuple[str, ...]  # frames that agree with each other but not with the rest


@dataclass(frozen=True)
class UndecidedProjector:
    """A frame was left out because two poses of its projector explain its coordinates, and no other frame decides."""

    frame: str
    angle_deg: float  # between the two poses of the projector


Exclusion = (
    SurfaceDisagrees
    | NoCommonSurface
    | SeparateComponent
    | PoorPair
    | OpenPlace
    | CoordinatesDisagree
    | UndecidedProjector
)
"""Why a frame was not registered."""


@dataclass(frozen=True)
class UncertainRotation:
    """A frame may slip along the surface that other frames see, as on a vase without texture."""

    frame: str
    sigma_deg: float  # of the least known rotation, by all pairs of the frame


@dataclass(frozen=True)
class SeparatePoses:
    """Frames that are connected to each other but not to the largest component, in axes and a unit of their own."""

    frames: tuple[str, ...]
    T_world_camera: Float64[ndarray, "m 4 4"]  # in the axes of the first of these cameras
    baseline: Float64[ndarray, "m"]  # camera to projector


@dataclass(frozen=True)
class Registration:
    """Camera poses in the axes of the first registered frame's camera (looking along -z), and baselines."""

    names: tuple[str, ...]
    T_world_camera: Float64[ndarray, "n 4 4"]  # NaN where not registered
    baseline: Float64[ndarray, "n"]  # camera to projector; geometric mean 1 over the registered frames; NaN elsewhere
    registered: Bool[ndarray, "n"]
    component: Int64[ndarray, "n"]  # 0: the largest, which is registered; 1, 2, ...: others; -1: a single frame
    fitness: Float64[ndarray, "n"]  # share of each frame's judged points that agree; NaN where not registered
    edges: tuple[Edge, ...]
    exclusions: tuple[Exclusion, ...]  # one for each frame that was not registered
    uncertainties: tuple[UncertainRotation, ...]
    separate: tuple[SeparatePoses, ...] = ()  # of the other components
    turns_deg: tuple[float, ...] = ()  # after which the surface looks the same, so that pairs contradict each other
    ordered: bool = True  # frames follow each other in the order of capture; False: stated, or found not to be so
    by_order: tuple[str, ...] = ()  # frames of which the order of capture decided which side they show


def without_frames(registration: Registration, exclusions: Sequence[Exclusion]) -> Registration:
    """The registration without the frames that the exclusions name, each as a frame by itself."""
    names = {exclusion.frame for exclusion in exclusions}
    out = np.array([name in names for name in registration.names])
    return replace(
        registration,
        T_world_camera=np.where(out[:, None, None], np.nan, registration.T_world_camera),
        baseline=np.where(out, np.nan, registration.baseline),
        registered=registration.registered & ~out,
        component=np.where(out, -1, registration.component),
        fitness=np.where(out, np.nan, registration.fitness),
        exclusions=(*registration.exclusions, *exclusions),
        uncertainties=tuple(u for u in registration.uncertainties if u.frame not in names),
    )


def without_undecided(registration: Registration, undecided: Sequence[UndecidedProjector]) -> Registration:
    """The registration without those of its frames whose projector may stand at two places.

    The surface of such a frame is bent if the wrong one was taken, and hardly any agreement tells.
    """
    names = {name for name, here in zip(registration.names, registration.registered, strict=True) if here}
    return without_frames(registration, [doubt for doubt in undecided if doubt.frame in names])


# One known length sets the scale: the baseline of a frame, or the distance between two points picked in images.

PICKING_RADIUS_PX = 3.0  # around a picked pixel, of whose depths the median is taken
LEAST_METRES, MOST_METRES = 1e-9, 1e9  # of a known length: nothing that a camera sees is smaller
_METRIC = "mm"  # unit of a scan whose length was typed in inches
_NUMBER = r"([-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?)"
_PIXEL = rf"frame (.+?) ?\( *{_NUMBER} *, *{_NUMBER} *\)"
_BASELINE = re.compile(r"baseline of frame (.+?) *= *(.*)")
_BAR = re.compile(rf"distance (?:between|from) {_PIXEL} (?:and|to) {_PIXEL} *= *(.*)")


@dataclass(frozen=True)
class KnownLength:
    """A length in metres and what it belongs to: a baseline, or the distance between two picked pixels."""

    metres: float
    unit: str  # of the scan that gets its scale from it
    frames: tuple[str, ...]  # number or name of the frame, or of the two frames
    pixels: tuple[tuple[float, float], ...] = ()  # picked in them, (x, y); the centre of the first pixel is (.5, .5)

    def shrunk(self, factor: int) -> "KnownLength":
        """The same in images whose squares of `factor` pixels are one."""
        return replace(self, pixels=tuple((x / factor, y / factor) for x, y in self.pixels))

    @property
    def source(self) -> str:
        """Words for where the scale of a scan comes from."""
        if self.pixels:
            return "scale bar between frame {} and frame {}".format(*self.frames)
        return f"baseline of frame {self.frames[0]}"


def parse_known_length(text: str) -> KnownLength:
    """`baseline of frame 0 = 85 mm` or `distance between frame 3 (410.5, 200) and frame 7 (35, 80) = 50 mm`.

    Raises UserError where the text is neither, the unit is unknown, or the length is not above zero or beyond reason.
    """
    text = " ".join(text.split())
    if baseline := _BASELINE.fullmatch(text):
        frames, pixels, typed = (baseline[1],), (), baseline[2]
    elif bar := _BAR.fullmatch(text):
        frames, typed = (bar[1], bar[4]), bar[7]
        pixels = ((float(bar[2]), float(bar[3])), (float(bar[5]), float(bar[6])))
    else:
        raise UserError(
            f'--known-length "{text}": is not understood\n    cause:  it does not say what is so long\n'
            '    remedy: write "baseline of frame 0 = 85 mm" or '
            '"distance between frame 3 (410.5, 200) and frame 7 (35, 80) = 50 mm" (pixels x, y)'
        )
    length = parse_length(typed, f'--known-length "{text}"', LEAST_METRES, MOST_METRES)
    return KnownLength(length.metres, length.unit if length.unit in UNITS else _METRIC, frames, pixels)


def scale_to(
    known: KnownLength,
    unit: str,
    clouds: Sequence[FrameCloud],
    T_world_camera: Float64[ndarray, "n 4 4"],
    T_world_projector: Float64[ndarray, "n 4 4"],
) -> float:
    """Factor by which all positions must be multiplied for the length to be true, in `unit` (of `METRES`).

    Raises UserError where a frame does not exist or was not registered, or where nothing was decoded at a pixel.
    """
    index = [_frame_index(frame, clouds) for frame in known.frames]
    for k in index:
        if not np.isfinite(T_world_camera[k]).all():
            raise UserError(
                f"{clouds[k].name} was not registered, so a length in it cannot set the scale\n"
                "    remedy: give a length that involves registered frames"
            )
    if known.pixels:
        ends = [
            _point_at(clouds[k], pixel, T_world_camera[k], T_world_projector[k], PICKING_RADIUS_PX)
            for k, pixel in zip(index, known.pixels, strict=True)
        ]
        found = float(np.linalg.norm(ends[0] - ends[1]))
    else:
        k = index[0]
        found = float(np.linalg.norm(T_world_camera[k, :3, 3] - T_world_projector[k, :3, 3]))
    if found <= 0:
        raise UserError(f"{known.source}: the two ends are the same point\n    remedy: pick two different places")
    return known.metres / METRES[unit] / found


def is_index(frame: str, count: int) -> bool:
    """Whether a text is a number from 0 to below `count`."""
    return frame.isdecimal() and len(frame) <= len(str(count)) and int(frame) < count


def _frame_index(frame: str, clouds: Sequence[FrameCloud]) -> int:
    names = [c.name for c in clouds]
    if frame in names:
        return names.index(frame)
    if is_index(frame, len(names)):
        return int(frame)
    raise UserError(f'there is no frame "{frame}"\n    remedy: give its number (0 to {len(names) - 1}) or its name')


def _point_at(
    cloud: FrameCloud,
    pixel: tuple[float, float],
    T_world_camera: Float64[ndarray, "4 4"],
    T_world_projector: Float64[ndarray, "4 4"],
    radius_px: float,
) -> Float64[ndarray, "3"]:
    """World point of a picked pixel, at the median depth of what was decoded around it."""
    first = np.maximum(np.floor(np.array(pixel) - radius_px).astype(np.int64), 0)
    last = np.maximum(np.ceil(np.array(pixel) + radius_px).astype(np.int64), 0)
    around = cloud.coords[first[1] : last[1], first[0] : last[0]]
    row, column = np.nonzero(np.isfinite(around[..., 0]))
    uv_camera = first + np.stack([column, row], -1) + 0.5
    near = np.linalg.norm(uv_camera - pixel, axis=1) < radius_px
    if not near.any():
        raise UserError(
            f"{cloud.name}: nothing was decoded within {radius_px:g} pixels of ({pixel[0]:g}, {pixel[1]:g})\n"
            "    remedy: pick a place where the pattern can be seen"
        )
    # Not the cloud's points: bundle adjustment may have changed the relative pose, and depth depends on it.
    T = np.linalg.inv(T_world_camera) @ T_world_projector
    d_projector = directions(cloud.projector, around[row[near], column[near]].astype(np.float64))
    depth = camera_depth(T[:3, :3], T[:3, 3], directions(cloud.camera, uv_camera[near]), d_projector)
    ray = directions(cloud.camera, np.array([pixel], dtype=np.float64))[0]
    return T_world_camera[:3, :3] @ (float(np.median(depth)) * ray) + T_world_camera[:3, 3]
