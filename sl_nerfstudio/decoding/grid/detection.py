"""Where in an image the grid is: its scale and roll, the phases and symbols that the U-Net reads, and its nodes."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from sl_nerfstudio.decoding.decoded import DecodingError
from sl_nerfstudio.decoding.grid.graph import GridGraph, PhaseMaps, build_graph
from sl_nerfstudio.decoding.grid.phase_reader import measure_appearance, predict_maps
from sl_nerfstudio.decoding.grid.rectify import GridAppearance, RectifiedImage, guess_appearances, rectify
from sl_nerfstudio.decoding.grid.trained import load_unet

LEAST_NODES = 12  # fewer show no grid
_LEAST_RANGE = 4 / 255  # of brightness: an image with less is blank
# When a guess of the grid's appearance is good enough.
_BETTER = 1.3  # times the nodes of the best guess so far: only then another guess replaces it
_MANY_NODES = 100  # with so many nodes ...
_MANY_EDGES = 2.5  # ... and so many neighbours per node, further guesses are not tried
# When an image is rectified a second time, by the appearance that was measured in the first.
_SCALE_RANGE = (0.75, 1.3)  # measured over guessed period
_ROLL_RANGE = np.radians(15.0)
_PERIODS = (3.0, 80.0)  # pixels


@dataclass(frozen=True)
class DetectedGrid:
    """The grid of an image as the U-Net read it."""

    appearance: GridAppearance
    rectified: RectifiedImage
    maps: PhaseMaps
    graph: GridGraph


class GridDetector:
    """Finds the grid in images, with the trained U-Net."""

    def __init__(self) -> None:
        self._unet = load_unet()

    def detect(self, grey: Float32[ndarray, "h w"]) -> DetectedGrid:
        """Try the most probable appearances of the grid. Raises DecodingError if none shows enough crossings."""
        if float(np.ptp(grey)) < _LEAST_RANGE:
            raise DecodingError(
                "is blank: all pixels have nearly the same brightness",
                "the projector was off, or the exposure far too short or too long",
                "look at the image, and capture it again with the pattern visible",
            )
        best: DetectedGrid | None = None
        for appearance in guess_appearances(grey):
            found = self._read(grey, appearance)
            if best is None or len(found.graph.place) > _BETTER * len(best.graph.place):
                best = found
            nodes, edges = len(best.graph.place), int((best.graph.neighbour >= 0).sum())
            if edges > _MANY_EDGES * nodes > _MANY_EDGES * _MANY_NODES:
                break
        if best is None or len(best.graph.place) < LEAST_NODES:
            count = 0 if best is None else len(best.graph.place)
            raise DecodingError(
                f"shows no grid of lines ({count} crossings were found, {LEAST_NODES} are needed)",
                "the pattern is outside the camera's view, far out of focus, or too weak against other light; or it is "
                "not the coded grid",
                "capture again with the pattern sharp and well exposed, and a period at least 8 pixels wide",
            )
        return best

    def _read(self, grey: Float32[ndarray, "h w"], appearance: GridAppearance) -> DetectedGrid:
        """Rectify by a guess and read; once more if the phases show that the guess was far off."""
        rectified = rectify(grey, appearance)
        maps = predict_maps(rectified, self._unet)
        measured = measure_appearance(maps, appearance)
        if measured is not None and _far_off(measured, appearance):
            appearance = GridAppearance(float(np.clip(measured.period, *_PERIODS)), measured.roll)
            rectified = rectify(grey, appearance)
            maps = predict_maps(rectified, self._unet)
        return DetectedGrid(appearance, rectified, maps, build_graph(maps))


def _far_off(measured: GridAppearance, guess: GridAppearance) -> bool:
    ratio, turn = measured.period / guess.period, measured.roll - guess.roll
    return bool(not (_SCALE_RANGE[0] < ratio < _SCALE_RANGE[1]) or abs(turn) > _ROLL_RANGE)
