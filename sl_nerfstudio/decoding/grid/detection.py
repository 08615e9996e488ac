"""Where in an image the grid is: its scale and roll, what the networks read there, and where its nodes belong."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from sl_nerfstudio.decoding.grid.consensus import LEAST_PIECE, Assignment
from sl_nerfstudio.decoding.grid.graph import GridGraph, PhaseMaps, build_graph, without_fragments
from sl_nerfstudio.decoding.grid.phase_reader import clear_places, measure_appearance, node_places, predict_maps
from sl_nerfstudio.decoding.grid.recognition import NodeRecogniser
from sl_nerfstudio.decoding.grid.rectify import PERIODS, GridAppearance, RectifiedImage, guess_appearances, rectify
from sl_nerfstudio.decoding.grid.trained import load_unet
from sl_nerfstudio.pattern.grid import GridPattern

LEAST_NODES = 12  # fewer known places show no grid
# When further guesses of the grid's appearance are not tried.
_MANY_NODES = 100
_MOST = 0.6  # share of all nodes that have a place
# When an image is rectified a second time, by the appearance that was measured in the first.
_SCALE_RANGE = (0.75, 1.3)  # measured over guessed period
_ROLL_RANGE = np.radians(15.0)


@dataclass(frozen=True)
class DetectedGrid:
    """The grid of an image as the networks read it."""

    appearance: GridAppearance
    rectified: RectifiedImage
    maps: PhaseMaps
    graph: GridGraph
    assignment: Assignment

    @property
    def nodes(self) -> int:
        """Number of crossings that are joined to others."""
        return len(self.graph.place)

    @property
    def known(self) -> int:
        """Number of crossings whose place in the pattern is known."""
        return int(self.assignment.known.sum())


class GridDetector:
    """Finds the grid of one pattern in images, with the trained networks."""

    def __init__(self, pattern: GridPattern) -> None:
        self._unet = load_unet()
        self._recogniser = NodeRecogniser(pattern)

    def detect(self, grey: Float32[ndarray, "h w"]) -> DetectedGrid | None:
        """The reading in which most nodes have a place, after trying the most probable appearances of the grid.

        Textures show crossings, too, but hardly any of them fits the pattern. None for an image without contrast.
        """
        best: DetectedGrid | None = None
        for appearance in guess_appearances(grey):
            found = self._read(grey, appearance)
            if best is None or (found.known, found.nodes) > (best.known, best.nodes):
                best = found
            if best.known > max(_MANY_NODES, _MOST * best.nodes):
                break
        return best

    def assign(self, graph: GridGraph) -> Assignment:
        """The places of a graph's nodes in the pattern."""
        return self._recogniser.assign(graph)

    def _read(self, grey: Float32[ndarray, "h w"], appearance: GridAppearance) -> DetectedGrid:
        """Rectify by a guess and read; once more if what fits the pattern shows that the guess was far off."""
        found = self._read_once(grey, appearance)
        known = found.assignment.known
        where = clear_places(found.maps) if found.known < LEAST_NODES else node_places(found.maps, found.graph, known)
        measured = measure_appearance(found.maps, appearance, where)
        if measured is None or not _far_off(measured, appearance):
            return found
        period = float(np.clip(measured.period, *PERIODS))
        again = self._read_once(grey, GridAppearance(period, measured.roll))
        return again if (again.known, again.nodes) > (found.known, found.nodes) else found

    def _read_once(self, grey: Float32[ndarray, "h w"], appearance: GridAppearance) -> DetectedGrid:
        rectified = rectify(grey, appearance)
        maps = predict_maps(rectified, self._unet)
        graph = without_fragments(build_graph(maps), LEAST_PIECE)
        return DetectedGrid(appearance, rectified, maps, graph, self.assign(graph))


def _far_off(measured: GridAppearance, guess: GridAppearance) -> bool:
    ratio, turn = measured.period / guess.period, measured.roll - guess.roll
    return bool(not (_SCALE_RANGE[0] < ratio < _SCALE_RANGE[1]) or abs(turn) > _ROLL_RANGE)
