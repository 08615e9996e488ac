"""Where in an image the grid is; and the error where it is not, with the causes that measurements show."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, Int32
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.decoding.decoder import DecodingError, Layer, Mask
from sl_nerfstudio.decoding.grid_edges import load_graph_network
from sl_nerfstudio.decoding.grid_graph import (
    DOWN,
    LEAST_PIECE,
    LEFT,
    RIGHT,
    UP,
    Assignment,
    GridGraph,
    PhaseMaps,
    agree,
    believe,
    build_graph,
    choose_turn,
    component_of,
    neighbourhoods,
    one_hot,
    turned_pattern,
    without_fragments,
)
from sl_nerfstudio.decoding.grid_phases import (
    PERIODS,
    RECTIFIED_PERIOD,
    STRIDE,
    GridAppearance,
    Maps,
    RectifiedImage,
    clear_places,
    guess_appearances,
    measure_appearance,
    network_channels,
    node_places,
    predict_maps,
    rectify,
)
from sl_nerfstudio.pattern.codes import rotate_codes
from sl_nerfstudio.pattern.grid import GridPattern

# Which node of the pattern each node of a capture is, by the graph network and by consensus among neighbours.

_BATCH = 2000  # nodes


class NodeRecogniser:
    """The graph network together with the features of all nodes of one pattern."""

    def __init__(self, pattern: GridPattern) -> None:
        self.codes = np.asarray(pattern.codes)
        self._network = load_graph_network()
        turned = turned_pattern(self.codes)
        features = self._features_of(one_hot(turned.symbol), turned.around)
        self._candidates = [features[torch.from_numpy(turned.turn == turn)] for turn in range(4)]

    def assign(self, graph: GridGraph) -> Assignment:
        """The place in the pattern of every node of a graph."""
        features = self._features_of(torch.from_numpy(graph.score), neighbourhoods(graph.neighbour))
        best, total = self._best_by_turn(features)
        turn = choose_turn(best)
        codes = rotate_codes(self.codes, turn)
        place = np.full((len(graph.place), 2), -1, dtype=np.int32)
        for index in _batches(graph.neighbour):
            own = self._logits(features[index], self._candidates[turn]).numpy() - total[index, None]
            place[index] = believe(own.reshape(-1, *codes.shape), graph.part(index).neighbour)
        return Assignment(turn, agree(place, graph, codes))

    def _features_of(self, score: Float[Tensor, "n 5"], around: Int32[ndarray, "n 25"]) -> Float[Tensor, "n features"]:
        with torch.inference_mode():
            return self._network(score, torch.from_numpy(around.astype(np.int64)))

    def _logits(self, features: Float[Tensor, "k features"], candidates: Float[Tensor, "m features"]) -> Tensor:
        with torch.inference_mode():
            return self._network.logits(features, candidates)

    def _best_by_turn(
        self, features: Float[Tensor, "n features"]
    ) -> tuple[Float32[ndarray, "n 4"], Float32[ndarray, "n"]]:
        """The highest log probability of each node in each quarter turn, and the logarithm of its odds' sum."""
        best, total = (np.empty((len(features), 4), dtype=np.float32) for _ in range(2))
        for start in range(0, len(features), _BATCH):
            part = slice(start, start + _BATCH)
            for turn, candidates in enumerate(self._candidates):
                logits = self._logits(features[part], candidates)
                best[part, turn], total[part, turn] = logits.amax(1).numpy(), torch.logsumexp(logits, 1).numpy()
        every = np.logaddexp.reduce(total, axis=1)
        return best - every[:, None], every


def _batches(neighbour: Int32[ndarray, "n 4"]) -> Iterator[Int32[ndarray, "k"]]:
    """Numbers of the nodes, whole components at a time, about `_BATCH` of them: a belief takes a lot of memory."""
    component = component_of(neighbour)
    first = np.cumsum(np.bincount(component, minlength=1)) // _BATCH  # the batch of each component
    batch = first[component]
    for number in np.unique(batch):
        yield np.nonzero(batch == number)[0].astype(np.int32)


# Where in an image the grid is: its scale and roll, what the networks read there, and where its nodes belong.

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

    def __init__(self, pattern: GridPattern, unet: Maps) -> None:
        self._unet = unet
        self.recogniser = NodeRecogniser(pattern)

    def detect(self, grey: Layer) -> DetectedGrid | None:
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

    def _read(self, grey: Layer, appearance: GridAppearance) -> DetectedGrid:
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

    def _read_once(self, grey: Layer, appearance: GridAppearance) -> DetectedGrid:
        rectified = rectify(grey, appearance)
        maps = predict_maps(rectified, self._unet)
        graph = without_fragments(build_graph(maps), LEAST_PIECE)
        return DetectedGrid(appearance, rectified, maps, graph, self.recogniser.assign(graph))


def _far_off(measured: GridAppearance, guess: GridAppearance) -> bool:
    ratio, turn = measured.period / guess.period, measured.roll - guess.roll
    return bool(not (_SCALE_RANGE[0] < ratio < _SCALE_RANGE[1]) or abs(turn) > _ROLL_RANGE)


# Measurements on the symbols of a grid that does not fit the pattern: can they be read, and do they fit mirrored?

MIRRORED_SYMBOL = (0, 2, 1, 4, 3)
"""What a left-right mirror makes of each symbol: its lines left and right change places, those above and below lean to
the other side."""
_LEAST_GRID = 40  # nodes of the largest component
_LEAST_EDGES = 2.6  # a node
_LEAST_CERTAINTY = 0.6  # mean probability of the most probable symbol; chance is a fifth
_LEAST_SHARE = 0.06  # of each of the five symbols; a code array holds about a fifth of each


def mirrored(graph: GridGraph) -> GridGraph:
    """The graph that the left-right mirror image would show."""
    order = np.empty(4, dtype=int)
    order[[RIGHT, DOWN, LEFT, UP]] = LEFT, DOWN, RIGHT, UP
    place = graph.place * np.array([-1, 1], dtype=np.float32)
    return GridGraph(place, graph.neighbour[:, order].copy(), graph.score[:, list(MIRRORED_SYMBOL)].copy())


def shows_grid(graph: GridGraph) -> bool:
    """Whether the largest component is large, and its nodes have neighbours in most directions."""
    grid = _largest_component(graph)
    return len(grid.place) >= _LEAST_GRID and bool((grid.neighbour >= 0).sum() >= _LEAST_EDGES * len(grid.place))


def shows_readable_symbols(graph: GridGraph) -> bool:
    """Whether there is a grid in which all five symbols appear, and they can be read."""
    score = _largest_component(graph).score
    share = np.bincount(score.argmax(-1), minlength=score.shape[1]) / max(len(score), 1)
    return shows_grid(graph) and bool(score.max(-1).mean() > _LEAST_CERTAINTY and share.min() > _LEAST_SHARE)


def _largest_component(graph: GridGraph) -> GridGraph:
    if len(graph.place) == 0:
        return graph
    component = component_of(graph.neighbour)
    return graph.part(np.nonzero(component == np.bincount(component).argmax())[0].astype(np.int32))


# Measurements of exposure: saturation, and how far details stand out from the noise.

_SATURATED = 0.995  # of the full scale
_ROUNDING = 1 / 255 / np.sqrt(12)  # standard deviation of rounding to 8 bits
_DETAIL = 1.0  # sigma of the smoothing before contrast is measured, pixels
_WINDOW = 10.0  # sigma of the window in which it is measured, pixels
_BEST = 0.98  # quantile of the local contrast: where the capture is best
_BRIGHT = 0.995  # quantile of the brightness
_LAPLACIAN = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
_NORMAL_MEDIAN = 0.6745  # of the absolute value of a standard normal variable


@dataclass(frozen=True)
class Exposure:
    """Brightness, contrast and noise of an image, each as a share of the full scale."""

    saturated: float  # share of the pixels at full scale
    bright: float  # brightness of its brightest parts
    contrast: float  # standard deviation of its details where they are strongest, without the noise
    noise: float  # standard deviation of its noise


def measure_exposure(grey: Layer) -> Exposure:
    """Exposure of an image in [0, 1].

    The noise is measured with a mask that is blind to planes and edges (Immerkaer, 1996), by the median.
    """
    smooth = cv2.GaussianBlur(grey, (0, 0), _DETAIL)
    mean = cv2.GaussianBlur(smooth, (0, 0), _WINDOW)
    variance = cv2.GaussianBlur((smooth - mean) ** 2, (0, 0), _WINDOW)
    noise = measure_noise(grey)
    left = noise**2 / (4 * np.pi * _DETAIL**2)  # what the smoothing leaves of the variance of white noise
    contrast = np.sqrt(max(float(np.quantile(variance, _BEST)) - left, 0.0))
    return Exposure(
        float((grey >= _SATURATED).mean()), float(np.quantile(grey, _BRIGHT)), float(contrast), float(noise)
    )


def measure_noise(grey: Layer) -> float:
    """Standard deviation of the noise of an image in [0, 1]; at least that of rounding to 8 bits."""
    residual = np.abs(cv2.filter2D(grey, -1, _LAPLACIAN)) / 6
    return max(float(np.median(residual)) / _NORMAL_MEDIAN, float(_ROUNDING))


# Measurements of sharpness: of the edges of an image, and of the lines of a grid whose phases are known.

_SMOOTHING = 1.0  # sigma against noise, pixels
_AGAIN = 2.5  # sigma of the second blur, with which the first is compared, pixels
_DIFFERENCE = 1 / 3  # variance of what a central difference blurs, pixels squared
_STRONGEST = 0.01  # share of the pixels that count as edges
_BLURS = np.linspace(0.03, 0.33, 16)  # periods
_BETWEEN = 0.2  # periods from the lines of the other family
_LEAST_FIRST = 0.1  # of the local contrast, sum of both families: with less there are no lines
_FEWEST = 100  # places of the maps


def edge_width(grey: Layer) -> float:
    """Sigma, in pixels, of the blur of the strongest edges; infinite without edges.

    A second blur of known width lowers the gradient of an edge the less, the wider the edge already is (Zhuo and Sim,
    2011).
    """
    once = cv2.GaussianBlur(grey, (0, 0), _SMOOTHING)
    twice = cv2.GaussianBlur(once, (0, 0), _AGAIN)
    slope, slope_after = _slope(once), _slope(twice)
    edge = slope >= max(float(np.quantile(slope, 1 - _STRONGEST)), 1e-6)
    if not edge.any():
        return float("inf")
    ratio = float(np.median(slope[edge] / np.maximum(slope_after[edge], 1e-9)))
    if ratio <= 1:
        return float("inf")
    return float(np.sqrt(max(_AGAIN**2 / (ratio**2 - 1) - _SMOOTHING**2 - _DIFFERENCE, 0.0)))


def _slope(image: Layer) -> Layer:
    gy, gx = np.gradient(image)
    return np.hypot(gx, gy)


def line_blur(rectified: RectifiedImage, maps: PhaseMaps, where: Mask, pattern: GridPattern) -> float | None:
    """Sigma, in periods, of the blur of a grid's lines at some places of the maps; None if they show no lines.

    The profile across the lines is compared with that of the drawn pattern at many blurs.
    """
    contrast = cv2.resize(
        network_channels(rectified.image)[0], None, fx=1 / STRIDE, fy=1 / STRIDE, interpolation=cv2.INTER_AREA
    )
    x = np.arctan2(maps.vector[1], maps.vector[0]) / (2 * np.pi)
    y = np.arctan2(maps.vector[3], maps.vector[2]) / (2 * np.pi)
    if where.sum() < _FEWEST:
        return None
    measured = _overtone(contrast[where], x[where], y[where])
    if measured is None:
        return None
    known = [overtone for overtone in _drawn_overtones(pattern) if overtone is not None]
    return float(np.interp(-measured, -np.array(known), _BLURS[: len(known)]))  # overtones fall as the blur grows


def _overtone(contrast: Float[ndarray, "n"], x: Float[ndarray, "n"], y: Float[ndarray, "n"]) -> float | None:
    """Strength of the second harmonic relative to the first, across both families of lines; None without a first."""
    first, second = 0.0, 0.0
    for across, along in ((x, y), (y, x)):
        between = np.abs(along) > _BETWEEN
        value = contrast[between] - contrast[between].mean()
        first += float((value * np.cos(2 * np.pi * across[between])).mean())
        second += float((value * np.cos(4 * np.pi * across[between])).mean())
    return second / first if first > _LEAST_FIRST else None


@lru_cache(maxsize=4)
def _drawn_overtones(pattern: GridPattern) -> tuple[float | None, ...]:
    """Overtones of the drawn pattern with each of the blurs, at the scale of a rectified image."""
    scale = RECTIFIED_PERIOD / pattern.period
    size = (round(pattern.w * scale) // STRIDE * STRIDE, round(pattern.h * scale) // STRIDE * STRIDE)
    column, row = np.meshgrid(*((np.arange(n // STRIDE) + 0.5) / (n // STRIDE) for n in size))
    x, y = (column * pattern.w - pattern.x0) / pattern.period, (row * pattern.h - pattern.y0) / pattern.period
    to_line = (x - np.rint(x)).ravel(), (y - np.rint(y)).ravel()
    drawn = pattern.render(1)
    found = []
    for blur in _BLURS:
        picture = cv2.GaussianBlur(drawn, (0, 0), blur * pattern.period)
        image = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
        channel = network_channels(image)[0]
        contrast = cv2.resize(channel, None, fx=1 / STRIDE, fy=1 / STRIDE, interpolation=cv2.INTER_AREA)
        found.append(_overtone(contrast.ravel(), *to_line))
    return tuple(found)


_BLANK = 4 / 255  # of brightness between the darkest and the brightest pixel
_MOST_SATURATED = 0.15  # share of the pixels
_LEAST_CONTRAST = 2.5  # of the details, in standard deviations of the noise
_DARK = 0.25  # brightness, of the brightest parts
_MOST_BLUR = 0.18  # sigma of the lines, periods: they are a fifth of a period wide
_WIDEST_EDGE = 1.8  # sigma of the sharpest edges, pixels: lines of a period of 10 are lost


@dataclass(frozen=True)
class Cause:
    """A measured cause of a failure, and its remedy."""

    words: str
    remedy: str


def refusal(grey: Layer, found: DetectedGrid | None, detector: GridDetector, pattern: GridPattern) -> DecodingError:
    """The error for a capture in which too few crossings have a place in the pattern."""
    if float(np.ptp(grey)) < _BLANK:
        return DecodingError(
            "is blank: all pixels have nearly the same brightness",
            "the projector was off, or the exposure far too short or too long",
            "look at the image, and capture it again with the pattern visible",
        )
    nodes, known = (found.nodes, found.known) if found is not None else (0, 0)
    causes = _causes(grey, found, detector, pattern)
    problem = f"shows {nodes} crossings of lines, but only {known} of them fit the pattern"
    if nodes < LEAST_NODES:
        problem = f"shows no grid of lines ({nodes} crossings were found, {LEAST_NODES} are needed)"
    remedies = dict.fromkeys(cause.remedy for cause in causes)
    return DecodingError(problem, "; ".join(cause.words for cause in causes), "; ".join(remedies))


def _causes(grey: Layer, found: DetectedGrid | None, detector: GridDetector, pattern: GridPattern) -> list[Cause]:
    """Every cause that a measurement shows; if there is none, that the pattern was looked for and is not there."""
    exposure = measure_exposure(grey)
    saturated = exposure.saturated > _MOST_SATURATED
    causes = [_saturation(exposure)] if saturated else _weakness(exposure)
    if found is not None:
        causes += _misfit(found, detector)
    if not (saturated and found is not None and shows_grid(found.graph)):  # saturated lines are wide, not blurred
        causes += _blur(grey, found, pattern)
    return causes or [_not_there(found)]


def _saturation(exposure: Exposure) -> Cause:
    share = f"{100 * exposure.saturated:.0f} %"
    return Cause(f"it is saturated: {share} of the pixels have the highest value", "capture again with less exposure")


def _weakness(exposure: Exposure) -> list[Cause]:
    if exposure.contrast >= _LEAST_CONTRAST * exposure.noise:
        return []
    facts = f"details of {255 * exposure.contrast:.1f} grey levels in noise of {255 * exposure.noise:.1f}"
    what = "it is too dark" if exposure.bright < _DARK else "the pattern is too weak"
    return [Cause(f"{what}: {facts}", "capture again with more light of the projector, or a longer exposure")]


def _misfit(found: DetectedGrid, detector: GridDetector) -> list[Cause]:
    """A grid that was read, and is not that of the pattern as it is."""
    if detector.recogniser.assign(mirrored(found.graph)).known.sum() >= LEAST_NODES:
        words = "the image is mirrored: its mirror image fits the pattern"
        return [Cause(words, "switch the projector from rear to front projection, or the camera's mirroring off")]
    if shows_readable_symbols(found.graph):
        words = "it shows another pattern: the symbols of its grid can be read, and fit this pattern nowhere"
        return [Cause(words, "give the pattern.json of the pattern that was projected")]
    return []


def _blur(grey: Layer, found: DetectedGrid | None, pattern: GridPattern) -> list[Cause]:
    """Check for blur: of the lines if there is a grid, else of the sharpest edges."""
    if found is None or not shows_grid(found.graph):
        sigma, most, words = edge_width(grey), _WIDEST_EDGE, "its sharpest edges have a sigma of {:.1f} pixels"
    else:
        sigma = line_blur(found.rectified, found.maps, clear_places(found.maps), pattern)
        most, words = _MOST_BLUR, "the lines have a sigma of {:.2f} periods"
    if sigma is None or sigma <= most:
        return []
    return [Cause(f"it is blurred: {words.format(sigma)}", "capture again in focus and with nothing moving")]


def _not_there(found: DetectedGrid | None) -> Cause:
    if found is None or found.nodes < LEAST_NODES:
        words = "the pattern is out of view: the image is neither dark, saturated nor blurred, and no part of it shows "
        words += "a grid"
    else:
        words = "not known: the image is neither dark, saturated, blurred nor mirrored, and its symbols cannot be "
        words += "read; the crossings may belong to a texture"
    remedy = "point the camera at what the projector lights, with the pattern brighter than other light and a period "
    return Cause(words, remedy + "at least 8 pixels wide")
