"""Captures of the coded grid, decoded by networks: one image, no calibration, no neighbouring frame."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int32, UInt8, UInt16
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.decoding.decoded import Decoded, DecodingError
from sl_nerfstudio.decoding.grid.consensus import Assignment, agree, choose_turn
from sl_nerfstudio.decoding.grid.dense_fit import DrawnGrid, draw_sharpnesses, fit_densely
from sl_nerfstudio.decoding.grid.evidence import symbol_evidence
from sl_nerfstudio.decoding.grid.gcn import one_hot, turned_pattern
from sl_nerfstudio.decoding.grid.graph import GridGraph, PhaseMaps, build_graph, neighbourhoods
from sl_nerfstudio.decoding.grid.reading import (
    PixelPhases,
    map_from_pixels,
    measured_look,
    read_view,
    to_pixel_coordinates,
    to_pixels,
)
from sl_nerfstudio.decoding.grid.rectify import GridLook, RectifiedImage, guess_looks, rectify
from sl_nerfstudio.decoding.grid.trained import load_graph_network, load_unet
from sl_nerfstudio.decoding.grid.unwrap import spread
from sl_nerfstudio.decoding.regions import drop_small_regions
from sl_nerfstudio.pattern.codes import rotate_codes
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.pattern.normalise import normalise_locally
from sl_nerfstudio.scan.images import as_grey

_LEAST_NODES = 12
_MOST_NODES = 1.5  # of those that the pattern has: some are seen twice at the borders of surfaces
_LEAST_KNOWN = 0.2  # share of the crossings that must find their place, else the pattern is another one
_SCALE_RANGE = (0.75, 1.3)  # of the view's period, within which it is not made anew
_ROLL_RANGE = np.radians(15.0)
_LEAST_AGREEMENT = 0.35  # of a capture with the pattern drawn
_RELATIVE_AGREEMENT = 0.66  # of the capture's median: a sharp capture agrees nearly everywhere
_LEAST_EVIDENCE = 0.3  # log-likelihood ratio of the symbols around a pixel
_SMALLEST_REGION = 2.0  # cells of the grid
_TEAR = 0.5  # periods
_NORMALISING = 0.8  # window of the local intensity normalisation, periods


@dataclass(frozen=True)
class _Sight:
    """A view and what was read in it."""

    look: GridLook
    view: RectifiedImage
    maps: PhaseMaps
    graph: GridGraph


class NetworkDecoder:
    """Decodes captures of one grid pattern. Made once, used for all frames; the same capture gives the same result."""

    def __init__(self, pattern: GridPattern) -> None:
        self.pattern = pattern
        self._unet, self._gcn = load_unet(), load_graph_network()
        codes = np.asarray(pattern.codes)
        self._turned = turned_pattern(codes)
        with torch.inference_mode():
            around = torch.from_numpy(self._turned.around.astype(np.int64))
            self._features = self._gcn(one_hot(self._turned.symbol), around)

    def decode(self, image: UInt8[ndarray, "h w *c"] | UInt16[ndarray, "h w *c"]) -> Decoded:
        """Projector coordinates of every pixel that shows the pattern.

        `image` is grey (h, w) or RGB (h, w, 3), 8 or 16 bit. Raises DecodingError if it shows no pattern, or
        another one.
        """
        grey = as_grey(image)
        sight = self._look(grey)
        seen = len(sight.graph.place)
        if seen > _MOST_NODES * self.pattern.rows * self.pattern.columns:
            raise DecodingError(
                f"shows {seen} crossings of lines, and the pattern has only {self.pattern.rows * self.pattern.columns}",
                "the image is mostly noise, or it shows another pattern",
                "give the pattern.json of the pattern that was projected; capture again with more light",
            )
        assignment = self.assign(sight.graph)
        known = assignment.known
        if known.sum() < max(_LEAST_NODES, _LEAST_KNOWN * seen):
            raise DecodingError(
                f"shows a grid of {seen} crossings, but only {int(known.sum())} of them fit the pattern",
                "the pattern's description belongs to another pattern, the image is mirrored, or it is too blurred "
                "or noisy to tell the symbols apart",
                "give the pattern.json of the pattern that was projected; capture again in focus, or from nearer by",
            )
        phases = to_pixels(sight.maps, sight.view, (grey.shape[0], grey.shape[1]))
        coords = self._dense(phases, sight, assignment)
        coords = self._sharpened(grey, coords, sight.look)
        mask = phases.mask | np.isfinite(coords[..., 0])
        return Decoded(coords, mask, self._normalised(grey, mask, sight.look.period))

    def assign(self, graph: GridGraph) -> Assignment:
        """The place of every node of a graph in the pattern."""
        judgement = self.judge(torch.from_numpy(graph.score), neighbourhoods(graph.neighbour))
        log_probability = torch.log_softmax(judgement, dim=1).numpy()
        turn = choose_turn(log_probability, self._turned.turn)
        codes = rotate_codes(np.asarray(self.pattern.codes), turn)
        own = log_probability[:, self._turned.turn == turn].reshape(-1, *codes.shape)
        return agree(own, graph, codes, turn)

    def judge(self, score: Float[Tensor, "n 5"], around: Int32[ndarray, "n 25"]) -> Float[Tensor, "n m"]:
        """How much each node looks like each node of the pattern in its four quarter turns.

        Candidates stand in the order of `turned_pattern`; `score` and `around` are a graph's symbol scores and its
        `neighbourhoods`.
        """
        with torch.inference_mode():
            features = self._gcn(score, torch.from_numpy(around.astype(np.int64)))
            return self._gcn.logits(features, self._features)

    def _look(self, grey: Float32[ndarray, "h w"]) -> _Sight:
        """Try the probable appearances of the grid until crossings are found."""
        if float(np.ptp(grey)) < 4 / 255:
            raise DecodingError(
                "is blank: all pixels have nearly the same brightness",
                "the projector was off, or the exposure far too short or too long",
                "look at the image, and capture it again with the pattern visible",
            )
        best: _Sight | None = None
        for look in guess_looks(grey):
            sight = self._read(grey, look)
            if best is None or len(sight.graph.place) > 1.3 * len(best.graph.place):
                best = sight
            if (best.graph.neighbour >= 0).sum() > 2.5 * len(best.graph.place) > 250:
                break
        if best is None or len(best.graph.place) < _LEAST_NODES:
            found = 0 if best is None else len(best.graph.place)
            raise DecodingError(
                f"shows no grid of lines ({found} crossings were found, {_LEAST_NODES} are needed)",
                "the pattern is out of the camera's view, far out of focus, or drowned in other light; or it is not "
                "the coded grid",
                "capture again with the pattern sharp and well exposed, a period at least 8 pixels wide",
            )
        return best

    def _read(self, grey: Float32[ndarray, "h w"], look: GridLook) -> _Sight:
        """Read the view that a guess gives, and once more if what is read says that the guess was off."""
        view = rectify(grey, look)
        maps = read_view(view, self._unet)
        measured = measured_look(maps, look)
        if measured is not None:
            ratio, turn = measured.period / look.period, measured.roll - look.roll
            if not (_SCALE_RANGE[0] < ratio < _SCALE_RANGE[1]) or abs(turn) > _ROLL_RANGE:
                look = GridLook(float(np.clip(measured.period, 3.0, 80.0)), measured.roll)
                view = rectify(grey, look)
                maps = read_view(view, self._unet)
        return _Sight(look, view, maps, build_graph(maps))

    def _dense(self, phases: PixelPhases, sight: _Sight, assignment: Assignment) -> Float32[ndarray, "h w 2"]:
        """Coordinates in pattern pixels from the nodes' places and the phases."""
        known = assignment.known
        at = np.floor(to_pixel_coordinates(sight.graph.place[known], sight.view)).astype(np.int32)
        turned = spread(phases.phase, phases.clear, np.ascontiguousarray(at[:, ::-1]), assignment.place[known])
        codes = rotate_codes(np.asarray(self.pattern.codes), assignment.turn)
        to_map = map_from_pixels(sight.view)
        evidence = symbol_evidence(turned, codes, sight.maps.symbol, to_map, sight.look.period)
        turned = np.where((evidence > _LEAST_EVIDENCE)[..., None], turned, np.float32(np.nan))
        return self._unturned(turned, assignment.turn)

    def _unturned(self, turned: Float32[ndarray, "h w 2"], turn: int) -> Float32[ndarray, "h w 2"]:
        """From periods (x, y) in the turned array to pattern pixels; NaN beyond the pattern."""
        grid = self.pattern
        x, y = turned[..., 0], turned[..., 1]
        i, j = (
            (y, x),
            (grid.rows - 1 - x, y),
            (grid.rows - 1 - y, grid.columns - 1 - x),
            (x, grid.columns - 1 - y),
        )[turn]
        coords = np.stack([grid.x0 + j * grid.period, grid.y0 + i * grid.period], -1).astype(np.float32)
        return np.where(_inside(coords, grid)[..., None], coords, np.float32(np.nan))

    def _sharpened(
        self, grey: Float32[ndarray, "h w"], coords: Float32[ndarray, "h w 2"], look: GridLook
    ) -> Float32[ndarray, "h w 2"]:
        """Fitted to the image, without what does not agree with it and without small pieces."""
        period, pixels = self.pattern.period, look.period
        sharp, agreement = fit_densely(grey, coords, self._drawn, pixels)
        known = np.isfinite(coords[..., 0])
        usual = float(np.median(agreement[known])) if known.any() else 0.0
        kept = (agreement > max(_LEAST_AGREEMENT, _RELATIVE_AGREEMENT * usual)) & _inside(sharp, self.pattern)
        sharp = np.where(kept[..., None], sharp, np.float32(np.nan))
        return drop_small_regions(sharp, _TEAR * period, round(_SMALLEST_REGION * pixels**2))

    @cached_property
    def _drawn(self) -> tuple[DrawnGrid, ...]:
        return draw_sharpnesses(self.pattern.render(), self.pattern.period)

    def _normalised(
        self, grey: Float32[ndarray, "h w"], mask: Bool[ndarray, "h w"], period: float
    ) -> Float32[ndarray, "h w"]:
        picture = self._drawn[0].layers[..., 0]
        return normalise_locally(grey, mask, _NORMALISING * period, float(picture.mean()), float(picture.std()))


def _inside(coords: Float32[ndarray, "h w 2"], grid: GridPattern) -> Bool[ndarray, "h w"]:
    """Pixels whose coordinates lie in the pattern; NaN lies nowhere."""
    x, y = coords[..., 0], coords[..., 1]
    return (x >= 0) & (x <= grid.w) & (y >= 0) & (y <= grid.h)
