"""Selection of images: sharp and well exposed ones that show the pattern elsewhere than those kept before."""

from dataclasses import dataclass, field
from enum import Enum

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8
from numpy import ndarray
from scipy.ndimage import maximum_filter

from sl_nerfstudio.decoding.grid_detection import LEAST_NODES, GridDetector, edge_width, line_blur
from sl_nerfstudio.decoding.grid_networks import LoadedNetworks
from sl_nerfstudio.decoding.grid_phases import clear_places, to_pixel_coordinates
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.scan.images import as_grey

# Exposure of an image, where it matters: where the pattern is.

_SATURATED = 0.995  # of full scale
_DARK = 0.06  # of full scale: lines as dark as this are lost in the noise of most cameras


@dataclass(frozen=True)
class Exposure:
    """Shares of the places that show the pattern; of the whole image where none does."""

    saturated: float  # a pixel at full scale
    dark: float  # nothing brighter than a few hundredths of full scale, not even the lines


def measure_light(
    grey: Float32[ndarray, "h w"], at: Float32[ndarray, "n 2"] | None = None, period: float = 8.0
) -> Exposure:
    """The light at pixels (x, y), in windows of a period of the pattern around them; without them, everywhere."""
    side = max(3, round(period))
    brightest = maximum_filter(grey, side)
    if at is None:
        return Exposure(float((grey >= _SATURATED).mean()), float((brightest < _DARK).mean()))
    h, w = grey.shape
    x, y = np.clip(at.astype(np.int64), 0, (w - 1, h - 1)).T
    marked = np.zeros(grey.shape, dtype=np.uint8)
    marked[y, x] = 1
    inside = maximum_filter(marked, side) > 0
    return Exposure(float((grey[inside] >= _SATURATED).mean()), float((brightest[y, x] < _DARK).mean()))


# What a single image shows of the coded grid, fast enough for several images a second.
#
# The decoder's detector finds the nodes of the grid and recognises them. Coordinates between them, which cost most of
# the decoding, are not needed to judge an image.

_LONGEST_SIDE = 960  # pixels of the reduced image in which the grid is looked for
_SAME_PLACE = 0.25  # periods: a node that is farther away than this shows another place


@dataclass(frozen=True, eq=False)
class GridView:
    """The nodes of the grid in one image, and how well they can be seen."""

    uv: Float32[ndarray, "rows columns 2"]  # pixel (x, y) of every node of the pattern; NaN where it was not found
    period: float  # of the grid in the image, pixels
    blur: float | None  # sigma of the lines, periods; None where too little of the grid was found
    light: Exposure
    edge: float | None = None  # sigma of the sharpest edges, pixels; only where no pattern is found

    @property
    def seen(self) -> Bool[ndarray, "rows columns"]:
        """Nodes that were found."""
        return np.isfinite(self.uv[..., 0])

    def difference(self, other: "GridView") -> float:
        """Share of the nodes seen in either view that the other one does not show at the same place, from 0 to 1.

        It is 0 for two images from the same place, and 1 where all nodes have moved or are others.
        """
        either = int((self.seen | other.seen).sum())
        if either == 0:
            return 1.0
        step = np.linalg.norm(self.uv - other.uv, axis=-1)  # NaN where one of them was not found
        same = int((step < _SAME_PLACE * min(self.period, other.period)).sum())
        return 1 - same / either


class GridReader:
    """Reads images of one pattern."""

    def __init__(self, pattern: GridPattern) -> None:
        self.pattern = pattern
        self._detector = GridDetector(pattern, LoadedNetworks().unet)

    def read(self, image: UInt8[ndarray, "h w *c"]) -> GridView:
        """The nodes in an image, grey or RGB; none if it does not show the pattern."""
        step = max(1, -(-max(image.shape[:2]) // _LONGEST_SIDE))
        size = (image.shape[1] // step, image.shape[0] // step)
        small = image if step == 1 else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        grey = as_grey(small)
        uv = np.full((self.pattern.rows, self.pattern.columns, 2), np.nan, dtype=np.float32)
        found = self._detector.detect(grey)
        if found is None or found.known < LEAST_NODES:
            return GridView(uv, float("nan"), None, measure_light(grey), edge_width(grey))
        known = found.assignment.known
        scale = np.array([image.shape[1] / grey.shape[1], image.shape[0] / grey.shape[0]], dtype=np.float32)
        at = to_pixel_coordinates(found.graph.place[known], found.rectified)
        row, column = self._upright(found.assignment.place[known], found.assignment.turn)
        uv[row, column] = at * scale
        blur = line_blur(found.rectified, found.maps, clear_places(found.maps), self.pattern)
        period = float(found.appearance.period * scale.mean())
        return GridView(uv, period, blur, measure_light(grey, at, found.appearance.period))

    def _upright(self, place: ndarray, turn: int) -> tuple[ndarray, ndarray]:
        """Row and column in the pattern of places in the pattern turned clockwise by `turn` quarter turns."""
        row, column = place.T
        last_row, last_column = self.pattern.rows - 1, self.pattern.columns - 1
        return ((row, column), (last_row - column, row), (last_row - row, last_column - column),
                (column, last_column - row))[turn]  # fmt: skip


class PlainReader:
    """Measures light and sharpness of images that show no pattern, such as those of a board."""

    def read(self, image: UInt8[ndarray, "h w *c"]) -> GridView:
        """A view without nodes."""
        grey = as_grey(image)
        return GridView(
            np.zeros((0, 0, 2), dtype=np.float32), float("nan"), None, measure_light(grey), edge_width(grey)
        )


class SelectionVerdict(Enum):
    """Verdict on an image."""

    KEEP = "keep"
    NO_PATTERN = "no pattern"  # not enough of it
    BLURRED = "blurred"
    SATURATED = "saturated"
    DARK = "dark"
    KNOWN = "known"  # much the same as one that was kept
    WAIT = "wait"  # too soon after the last one
    BY_KEY = "by key"  # without a pattern, nothing is kept by itself


# What an image must have to be kept. Where the pattern is:
_LEAST_NODES = 48  # four times what decoding needs
MOST_BLUR = 0.15  # periods; lines are 0.2 wide, and from 0.18 on captures are refused
_MOST_SATURATED = 0.15  # the same limit as in decoding
_MOST_DARK = 0.3
# In the whole image, where no pattern is found:
_MOST_WHITE, _MOST_BLACK = 0.5, 0.9
_WIDEST_EDGE = 1.8  # pixels; the same limit as in decoding
# And what is new:
_LEAST_DIFFERENCE = 0.5  # from every kept view; that of two images from one place is below 0.02
_PAUSE = 1.0  # seconds after the last one


@dataclass
class Selection:
    """The views that were kept, and the judgement of the next."""

    shape: tuple[int, int]  # rows and columns of the pattern
    kept: list[GridView] = field(default_factory=list)
    last: float = -np.inf  # seconds, when the last one was kept

    def judge(self, view: GridView, seconds: float) -> SelectionVerdict:
        """Whether to keep a view, or the first reason against it."""
        if view.uv.size == 0:
            return SelectionVerdict.BY_KEY
        if view.seen.sum() < _LEAST_NODES:
            return self._without_pattern(view)
        if view.light.saturated > _MOST_SATURATED:
            return SelectionVerdict.SATURATED
        if view.light.dark > _MOST_DARK:
            return SelectionVerdict.DARK
        if view.blur is None or view.blur > MOST_BLUR:
            return SelectionVerdict.BLURRED
        if min((view.difference(other) for other in self.kept), default=1.0) < _LEAST_DIFFERENCE:
            return SelectionVerdict.KNOWN
        return SelectionVerdict.KEEP if seconds - self.last >= _PAUSE else SelectionVerdict.WAIT

    def _without_pattern(self, view: GridView) -> SelectionVerdict:
        """Light and blur are named as the reason only where they hide a pattern anywhere in the image."""
        if view.light.saturated > _MOST_WHITE:
            return SelectionVerdict.SATURATED
        if view.light.dark > _MOST_BLACK:
            return SelectionVerdict.DARK
        blurred = view.edge is not None and view.edge > _WIDEST_EDGE
        return SelectionVerdict.BLURRED if blurred else SelectionVerdict.NO_PATTERN

    def add(self, view: GridView, seconds: float = -np.inf) -> None:
        """Keep a view."""
        self.kept.append(view)
        self.last = max(self.last, seconds)

    @property
    def times_seen(self) -> Int[ndarray, "rows columns"]:
        """Number of kept views in which each node of the pattern was found."""
        return np.sum([np.zeros(self.shape, dtype=np.int64), *(view.seen for view in self.kept)], axis=0)
