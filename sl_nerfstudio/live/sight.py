"""What one image shows by itself: the surface in front of the camera, or why there is none.

The image is decoded at the size at which the grid can just be read well, and without a look at edges: that is enough to
know where a frame is, and takes a third of the time. Where that is its full size, what was read is kept: decoding a
kept frame goes on from there.
"""

from dataclasses import dataclass, replace
from enum import Enum

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

from sl_nerfstudio.capture.selection import MOST_BLUR, GridView, Selection, SelectionVerdict, measure_light
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
from sl_nerfstudio.scan.images import as_grey

PERIOD = 7.8  # pixels of the grid at which images are decoded
PERIOD_REACH = 1.12  # factor by which it may depart from that before the size is changed
LARGEST_SIDE = 960  # pixels of the longer side at which the grid is looked for, as long as its period is not known
LATTICE = 320  # pixels of the longer side, about, on which a frame is placed
RAYS = RayCounts(fit=16000, polishing=300, ranking=1500)  # by which the relative pose is found
FINEST_PERIOD = 7.0  # pixels: a finer grid is hardly read, its object is too far away
SMEAR_SIGMA, SMEARED = 1.5, 0.3  # pixels; gradients across the edges' direction over those along it
FEWEST_POINTS = 300  # of a frame's surface, on the lattice
WEAK = (
    "few points",
    "pure rotation",
    "small parallax",
    "planar",
    "ambiguous",
    "many outliers",
    "poor fit",
    "uncertain",
)


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
    first: FirstLook | None = None  # of its full size
    cloud: FrameCloud | None = None
    frame: Frame | None = None
    fault: Fault | None = None
    period: float = float("nan")  # of the grid, pixels of the image
    sharp: bool = False  # enough to be kept
    weak: tuple[str, ...] = ()  # degeneracies of the relative pose


class Eye:
    """Looks at the images of one camera."""

    def __init__(self, decoder: NetworkDecoder, camera: Device, projector: Device, seed: int = 0) -> None:
        """`camera` is that of the images as they come."""
        self.decoder, self.camera, self.projector, self._seed = decoder, camera, projector, seed
        self._selection = Selection((decoder.layout.rows, decoder.layout.columns))
        self.factor = self._largest = min(1.0, LARGEST_SIDE / max(camera.w, camera.h))

    @one_library_thread()
    def look(self, image: UInt8[ndarray, "h w *c"]) -> Sight:
        """Decode an image, and find the projector's relative pose and the surface."""
        camera, factor, grey = self.camera, self.factor, as_grey(image)
        if factor < 1:
            size = round(camera.w * factor), round(camera.h * factor)
            grey = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA))
            across, down = size[0] / camera.w, size[1] / camera.h
            camera = replace(camera, w=size[0], h=size[1], fl_x=camera.fl_x * across, fl_y=camera.fl_y * down,
                             cx=camera.cx * across, cy=camera.cy * down)  # fmt: skip
        try:
            found = self.decoder.images.detect(grey)
        except DecodingError:
            self.factor = self._largest
            return Sight(image, fault=self._fault(grey))
        period = float(found.appearance.period)
        if not 1 / PERIOD_REACH < period / PERIOD < PERIOD_REACH:
            self.factor = min(self._largest, factor * PERIOD / period)
        blur = line_blur(found.rectified, found.maps, clear_places(found.maps), self.decoder.layout)
        sharp = blur is not None and blur < MOST_BLUR
        first = FirstLook(grey, found, self.decoder.images.examine(grey, found))
        seen = Sight(image, first if factor == 1 else None, period=period / factor, sharp=sharp)
        step = max(1, round(max(camera.w, camera.h) / LATTICE))
        part = slice(step // 2, None, step)
        coords = np.ascontiguousarray(self.decoder.images.clear_coords(first)[part, part])
        if np.isfinite(coords[..., 0]).sum() < FEWEST_POINTS:
            little = Fault.TOO_LITTLE if sharp else Fault.BLURRED
            return replace(seen, fault=Fault.TOO_FAR if seen.period < FINEST_PERIOD else little)
        lattice = sampled(camera, step)
        try:
            matches = correspondences_of(coords)
            pose = estimate_relative_pose(*matches, lattice, self.projector, self._seed, RAYS)
            mask = np.ascontiguousarray(first.mask[part, part])
            cloud = frame_cloud("live", coords, lattice, self.projector, pose, seen=mask)
        except RelativePoseError:
            return replace(seen, fault=Fault.NO_RELATIVE_POSE)
        weak = tuple(d.kind for d in pose.degeneracies if d.kind in WEAK)
        return replace(seen, cloud=cloud, frame=Frame.of(cloud), weak=weak)

    def _fault(self, grey: Float32[ndarray, "h w"]) -> Fault:
        """Why an image shows no grid; motion blurs in one direction, and the edges of the other stay sharp."""
        nothing = np.full((*self._selection.shape, 2), np.nan, dtype=np.float32)
        view = GridView(nothing, float("nan"), None, measure_light(grey), edge_width(grey))
        fault = _FAULTS.get(self._selection.judge(view, 0.0), Fault.NO_PATTERN)
        return Fault.BLURRED if fault is Fault.NO_PATTERN and is_smeared(grey) else fault


def is_smeared(grey: Float32[ndarray, "h w"]) -> bool:
    """Whether nearly all edges have one direction, by the eigenvalues of the structure tensor: a grid has two."""
    smooth = cv2.GaussianBlur(grey, (0, 0), SMEAR_SIGMA)
    x, y = (cv2.Sobel(smooth, cv2.CV_32F, *order) for order in ((1, 0), (0, 1)))
    tensor = np.array([[(x * x).mean(), (x * y).mean()], [(x * y).mean(), (y * y).mean()]])
    small, large = np.linalg.eigvalsh(tensor)
    return bool(small < SMEARED * large)


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
