"""What one image shows by itself: the surface in front of the camera, or why there is none.

The image is decoded without a look at edges, and on each second pixel (see `Eye.step`): that is enough to know where a
frame is, and takes half the time. What was read is kept, so that decoding a kept frame goes on from there.
"""

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from sl_nerfstudio.capture.selection import DEFAULT_LIMITS, GridView, Selection, SelectionVerdict, measure_light
from sl_nerfstudio.decoding.decoder import DecodingError
from sl_nerfstudio.decoding.grid import FirstLook, NetworkDecoder
from sl_nerfstudio.decoding.grid_detection import edge_width, line_blur
from sl_nerfstudio.decoding.grid_phases import clear_places
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.parallel import one_library_thread
from sl_nerfstudio.registration.evidence import Frame
from sl_nerfstudio.registration.surfaces import FrameCloud, frame_cloud
from sl_nerfstudio.relative_pose.candidates import RayCounts
from sl_nerfstudio.relative_pose.epipolar import correspondences_of
from sl_nerfstudio.relative_pose.estimation import RelativePoseError, estimate_relative_pose
from sl_nerfstudio.scan.images import as_grey, shrunk

LATTICE = 320  # pixels of the longer side of the image on which a frame is placed
LARGEST_SIDE = 960  # pixels of the longer side of an image that is decoded as it is; larger ones are shrunk
RAYS = RayCounts(fit=8000, polishing=500, ranking=2500)  # by which the relative pose is found
FINEST_PERIOD = 7.0  # pixels: a finer grid is hardly read, its object is too far away
FEWEST_POINTS = 300  # of a frame's surface, on the lattice
WEAK = ("few points", "pure rotation", "small parallax", "planar", "ambiguous", "many outliers", "poor fit", "uncertain")


class Fault(Enum):
    """Why an image shows no surface."""

    NO_PATTERN = "no pattern"
    BLURRED = "blurred"
    DARK = "dark"
    BRIGHT = "bright"
    TOO_FAR = "too far"
    TOO_LITTLE = "too little"  # of the pattern was read
    NO_RELATIVE_POSE = "no relative pose"  # no pose of the projector explains what was read


_FAULTS = {
    SelectionVerdict.SATURATED: Fault.BRIGHT,
    SelectionVerdict.DARK: Fault.DARK,
    SelectionVerdict.BLURRED: Fault.BLURRED,
}


@dataclass(frozen=True)
class Sight:
    """An image and what it shows; without a frame, `fault` says why."""

    image: UInt8[ndarray, "h w *c"]
    first: FirstLook | None = None
    cloud: FrameCloud | None = None
    frame: Frame | None = None
    fault: Fault | None = None
    period: float = float("nan")  # of the grid, pixels of the image
    sharp: bool = False  # enough to be kept
    weak: tuple[str, ...] = ()  # degeneracies of the relative pose


class Eye:
    """Looks at images of one size."""

    def __init__(self, decoder: NetworkDecoder, camera: Device, projector: Device, seed: int = 0) -> None:
        """`camera` is that of the images as they come."""
        self.decoder, self.projector, self._seed = decoder, projector, seed
        self.shrink = -(-max(camera.w, camera.h) // LARGEST_SIDE)
        self.camera = camera.shrunk(self.shrink)
        self.step = max(1, round(max(self.camera.w, self.camera.h) / LATTICE))
        self.lattice = sampled(self.camera, self.step)
        self._selection = Selection((decoder.layout.rows, decoder.layout.columns))

    @one_library_thread()
    def look(self, image: UInt8[ndarray, "h w *c"]) -> Sight:
        """Decode an image, and find the projector's relative pose and the surface."""
        small = shrunk(image, self.shrink) if self.shrink > 1 else image
        try:
            first = self.decoder.images.look(small)
        except DecodingError:
            return Sight(image, fault=self._fault(small))
        period = float(first.found.appearance.period)
        blur = line_blur(first.found.rectified, first.found.maps, clear_places(first.found.maps), self.decoder.layout)
        sharp = blur is not None and blur < DEFAULT_LIMITS.most_blur
        seen = Sight(image, first, period=period * self.shrink, sharp=sharp)
        part = slice(self.step // 2, None, self.step)
        coords = np.ascontiguousarray(self.decoder.images.clear_coords(first)[part, part])
        if np.isfinite(coords[..., 0]).sum() < FEWEST_POINTS:
            too_far = period < FINEST_PERIOD
            little = Fault.TOO_LITTLE if sharp else Fault.BLURRED
            return replace(seen, fault=Fault.TOO_FAR if too_far else little)
        try:
            matches = correspondences_of(coords)
            pose = estimate_relative_pose(*matches, self.lattice, self.projector, self._seed, RAYS)
            mask = np.ascontiguousarray(first.mask[part, part])
            cloud = frame_cloud("live", coords, self.lattice, self.projector, pose, seen=mask)
        except RelativePoseError:
            return replace(seen, fault=Fault.NO_RELATIVE_POSE)
        weak = tuple(d.kind for d in pose.degeneracies if d.kind in WEAK)
        return replace(seen, cloud=cloud, frame=Frame.of(cloud), weak=weak)

    def _fault(self, image: UInt8[ndarray, "h w *c"]) -> Fault:
        grey = as_grey(image)
        nothing = np.full((*self._selection.shape, 2), np.nan, dtype=np.float32)
        view = GridView(nothing, float("nan"), None, measure_light(grey), edge_width(grey))
        return _FAULTS.get(self._selection.judge(view, 0.0), Fault.NO_PATTERN)


def sampled(camera: Device, step: int) -> Device:
    """The camera of an image of which only each so-manieth pixel is kept, beginning with number `step // 2`."""
    first = step // 2
    off = 0.5 - (first + 0.5) / step
    return replace(
        camera,
        w=len(range(first, camera.w, step)),
        h=len(range(first, camera.h, step)),
        fl_x=camera.fl_x / step,
        fl_y=camera.fl_y / step,
        cx=camera.cx / step + off,
        cy=camera.cy / step + off,
    )
