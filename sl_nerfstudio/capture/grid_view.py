"""What a single image shows of the coded grid, fast enough for several images a second.

The decoder's detector finds the nodes of the grid and recognises them. Coordinates between them, which cost most of the
decoding, are not needed to judge an image.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray

from sl_nerfstudio.capture.light import Light, measure_light
from sl_nerfstudio.decoding.grid.detection import LEAST_NODES, GridDetector
from sl_nerfstudio.decoding.grid.phase_reader import clear_places, to_pixel_coordinates
from sl_nerfstudio.decoding.grid.refusal.sharpness import edge_width, line_blur
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.scan.images import as_grey

_LONGEST_SIDE = 960  # pixels of the reduced image in which the grid is looked for
_SAME_PLACE = 0.25  # periods: a node that is farther away than this shows another place


@dataclass(frozen=True, eq=False)
class GridView:
    """The nodes of the grid in one image, and how well they can be seen."""

    uv: Float32[ndarray, "rows columns 2"]  # pixel (x, y) of every node of the pattern; NaN where it was not found
    period: float  # of the grid in the image, pixels
    blur: float | None  # sigma of the lines, periods; None where too little of the grid was found
    light: Light
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
        self._detector = GridDetector(pattern)

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
