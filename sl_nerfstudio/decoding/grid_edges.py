"""The trained networks that come with the package, and the choice of coordinates beside edges."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeVar

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from numpy import ndarray
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional as F

from sl_nerfstudio.decoding.decoder import Coords, Layer, torn
from sl_nerfstudio.decoding.grid_fit import DrawnGrid
from sl_nerfstudio.decoding.grid_graph import GraphNetwork
from sl_nerfstudio.decoding.grid_phases import (
    STRIDE,
    LevelNetwork,
    Maps,
    RectifiedImage,
    UNet,
    from_pattern,
    integer_centres,
    network_channels,
    to_pattern,
)
from sl_nerfstudio.parallel import compiled
from sl_nerfstudio.pattern.grid import GridPattern, gaussian_window

# What the decoder knows about the pixels of a capture before it decides which of them to keep.


@dataclass(frozen=True)
class EdgeEvidence:
    """Coordinates and what tells the right ones from the wrong ones; NaN or anything where not decoded."""

    read: Coords  # coordinates that the network read, pattern pixels
    fitted: Coords  # the same, fitted to the image
    agreement: Layer  # correlation of image and drawn pattern
    log_ratio: Layer  # mean log-likelihood ratio of the symbols
    probability: Layer  # that the pattern is there


# Coordinates continued as a plane from a place some pixels away.
#
# The displacement of a pixel to a place on the same surface that is farther from its edge follows Ramamonjisoa et
# al., "Predicting sharp and accurate occlusion boundaries in monocular depth estimation using displacement fields"
# (2020); here the plane at that place is continued, not its value.

_DISTANCES = (3, 6, 9, 13)  # pixels of the rectified image
_DIRECTIONS = 8
_TORN_SLOPE = 0.3  # periods between neighbouring pixels: a larger difference is no slope
_LEAST_SEEN = 1e-3  # share of the window in which there is a slope
_SLOPE_WINDOW = 2.0  # sigma, pixels of the rectified image


def steps(distances: tuple[int, ...] = _DISTANCES) -> Int[ndarray, "k 2"]:
    """Steps (x, y) from a pixel to the places that it may be continued from; the first is the pixel itself."""
    angle = 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    around = np.stack([np.cos(angle), np.sin(angle)], -1)
    return np.rint(np.concatenate([[(0.0, 0.0)], *[r * around for r in distances]])).astype(np.int64)


def slopes(coords: Coords, period: float, scale: float = 1.0) -> Float32[ndarray, "h w 2 2"]:
    """Derivatives of coordinates (x, y) by pixels (x, y), means over a small window; NaN where there are none.

    `period` is in the unit of the coordinates; `scale` is the size of a pixel of the rectified image in pixels of this
    one.
    """
    total = np.empty((*coords.shape, 2), dtype=np.float32)
    count = np.empty(coords.shape, dtype=np.float32)
    _sum_steps(coords, np.float32(_TORN_SLOPE * period), total, count)
    out = gaussian_window(total.reshape(*coords.shape[:2], 4), _SLOPE_WINDOW * scale).reshape(total.shape)
    _divide(out, gaussian_window(count, _SLOPE_WINDOW * scale))
    return out


@compiled
def _sum_steps(coords: ndarray, tear: float, total: ndarray, count: ndarray) -> None:
    """Sums (axis, by x or y) of the steps to the neighbours on both sides that are not torn away, and their number."""
    h, w = coords.shape[:2]
    for row in range(h):
        for column in range(w):
            for by in range(2):
                x = y = np.float32(0)
                smooth = 0
                for side in range(2):  # the step to the next pixel, then the one from the pixel before
                    r, c = row - side * by, column - side * (1 - by)
                    rr, cc = r + by, c + 1 - by
                    if r < 0 or c < 0 or rr >= h or cc >= w:
                        continue
                    dx, dy = coords[rr, cc, 0] - coords[r, c, 0], coords[rr, cc, 1] - coords[r, c, 1]
                    if abs(dx) < tear and abs(dy) < tear:  # False for NaN
                        x, y, smooth = x + dx, y + dy, smooth + 1
                total[row, column, 0, by], total[row, column, 1, by], count[row, column, by] = x, y, smooth


@compiled
def _divide(total: ndarray, count: ndarray) -> None:
    """Means from sums, in place; NaN where hardly anything was added up."""
    h, w = count.shape[:2]
    for row in range(h):
        for column in range(w):
            for by in range(2):
                n = count[row, column, by]
                for axis in range(2):
                    total[row, column, axis, by] = total[row, column, axis, by] / n if n > _LEAST_SEEN else np.nan


def continued(coords: Coords, slope: Float32[ndarray, "h w 2 2"], step: Int[ndarray, "h w 2"]) -> Coords:
    """Coordinates at each pixel on the plane at the place `step` pixels (x, y) away; NaN where nothing is known there.

    A pixel whose step is zero keeps its coordinates.
    """
    out = np.empty_like(coords)
    _continue(coords, slope, step, out)
    return out


@compiled
def _continue(coords: ndarray, slope: ndarray, step: ndarray, out: ndarray) -> None:
    h, w = coords.shape[:2]
    for row in range(h):
        for column in range(w):
            dx, dy = step[row, column, 0], step[row, column, 1]
            r, c = row + dy, column + dx
            for axis in range(2):
                if dx == 0 and dy == 0:
                    out[row, column, axis] = coords[row, column, axis]
                elif 0 <= r < h and 0 <= c < w:
                    out[row, column, axis] = coords[r, c, axis] - slope[r, c, axis, 0] * dx - slope[r, c, axis, 1] * dy
                else:
                    out[row, column, axis] = np.nan


# What the edge network sees: the image, the coordinates, and how the pattern would look if surfaces were continued.
#
# All is in the rectified image, and coordinates are those of the turned pattern, so that its lines are nearly
# upright.

CHANNELS = 23
_TORN_PHASE = 0.35  # periods between neighbouring pixels
_LARGEST_RATIO = 2.0
_LARGEST_MOVE = 0.3  # periods
_MOVE_SCALE = 5.0  # so that moves are about as large as the other channels
_SEEN_FROM = 9  # pixels: surfaces are continued over this distance to compare them with the image


@dataclass(frozen=True)
class EdgeView:
    """The evidence of a capture in its rectified image; coordinates in periods, NaN where unknown."""

    measured: Float[ndarray, "7 h w"]  # contrast, brightness, pattern sharp and soft, agreement, ratio, probability
    fitted: Coords
    read: Coords
    continued: Float[ndarray, "8 h w"]  # the pattern as it is drawn where surfaces around are continued

    def part(self, rows: slice, columns: slice) -> "EdgeView":
        """A rectangle of it."""
        return EdgeView(self.measured[:, rows, columns], self.fitted[rows, columns], self.read[rows, columns],
                        self.continued[:, rows, columns])  # fmt: skip

    def channels(self) -> Float32[ndarray, "c h w"]:
        """The channels of the network."""
        known = np.isfinite(self.fitted[..., 0])
        angle = 2 * np.pi * np.nan_to_num(self.fitted)
        phase = np.stack([f(angle[..., axis]) for axis in (0, 1) for f in (np.cos, np.sin)])
        move = np.clip(np.nan_to_num(self.read - self.fitted), -_LARGEST_MOVE, _LARGEST_MOVE) * _MOVE_SCALE
        parts = [
            self.measured,
            known[None],
            phase * known,
            np.moveaxis(move, -1, 0),
            torn(self.fitted, _TORN_PHASE)[None],
        ]
        return np.concatenate([*parts, self.continued]).astype(np.float32)


def edge_view(
    evidence: EdgeEvidence, rectified: RectifiedImage, turn: int, grid: GridPattern, drawn: tuple[DrawnGrid, ...]
) -> EdgeView:
    """The evidence of a capture, turned and scaled as the rectified image is; `drawn` from sharp to soft."""
    fitted = moved_coords(from_pattern(evidence.fitted, grid, turn), rectified)
    read = moved_coords(from_pattern(evidence.read, grid, turn), rectified)
    known = np.isfinite(evidence.fitted[..., 0])
    ratio = np.clip(evidence.log_ratio, -_LARGEST_RATIO, _LARGEST_RATIO)
    layers = [one.at(evidence.fitted)[..., 0] * known for one in (drawn[0], drawn[-1])]
    layers += [np.nan_to_num(layer) for layer in (evidence.agreement, ratio, evidence.probability)]
    measured = [_moved(layer.astype(np.float32), rectified, cv2.INTER_LINEAR) for layer in layers]
    slope = slopes(fitted, 1.0)
    around = [
        _drawn_if_continued(fitted, slope, step, drawn[len(drawn) // 2], grid, turn)
        for step in steps((_SEEN_FROM,))[1:]
    ]
    return EdgeView(np.stack([*network_channels(rectified.image), *measured]), fitted, read, np.stack(around))


def _drawn_if_continued(
    fitted: Coords, slope: Float32[ndarray, "h w 2 2"], step: ndarray, drawn: DrawnGrid, grid: GridPattern, turn: int
) -> Layer:
    """The pattern where every pixel is continued from the place one step away; 0 where nothing is known there."""
    coords = continued(fitted, slope, np.broadcast_to(step, fitted.shape))
    return np.where(np.isfinite(coords[..., 0]), drawn.at(to_pattern(coords, grid, turn))[..., 0], np.float32(0))


def _moved(layer: Float32[ndarray, "h w *k"], rectified: RectifiedImage, flags: int) -> Float32[ndarray, "a b *k"]:
    size = rectified.image.shape[::-1]
    return cv2.warpAffine(layer, integer_centres(rectified.from_image), size, flags=flags)


def moved_coords(coords: Coords, rectified: RectifiedImage, tear: float = _TORN_PHASE) -> Float32[ndarray, "a b 2"]:
    """Coordinates in the rectified image; NaN where unknown.

    Bilinear where the four pixels around differ by less than `tear`, else those of the nearest pixel.
    """
    known = np.isfinite(coords[..., 0])
    values, weight = np.where(known[..., None], coords, np.float32(0)), known.astype(np.float32)
    near = _moved(values, rectified, cv2.INTER_NEAREST)
    linear = _moved(values, rectified, cv2.INTER_LINEAR)
    apart = np.abs(linear - near)
    smooth = (_moved(weight, rectified, cv2.INTER_LINEAR) > 0.999) & (np.maximum(apart[..., 0], apart[..., 1]) < tear)
    out = np.where(smooth[..., None], linear, near)
    return np.where((_moved(weight, rectified, cv2.INTER_NEAREST) > 0.5)[..., None], out, np.float32(np.nan))


# The edge network: from which place each pixel of a rectified image is continued, and how probably it is wrong.

_WIDTHS = (32, 48, 64, 64)
_STEPS = len(steps())
MARGIN = 112
"""Pixels around a part of an image on which its output depends, at most; a multiple of `unet.MULTIPLE`."""
_OWN = 2.0  # log odds of the pixel itself at the beginning of the training


class EdgeOutput(NamedTuple):
    """Prediction of the network for every pixel of its input."""

    step: Float[Tensor, "b k h w"]  # logit of each of `continuation.steps`
    wrong: Float[Tensor, "b h w"]  # logit: more than a tenth of a period off, or the pattern is not here


class EdgeNetwork(LevelNetwork):
    """Four levels; what they predict for 2 x 2 pixels is unfolded at the end."""

    def __init__(self) -> None:
        outputs = (_STEPS + 1) * STRIDE**2
        super().__init__(CHANNELS, _WIDTHS, outputs)
        bias = torch.zeros(outputs)
        bias[: STRIDE**2] = _OWN
        self.head.bias = nn.Parameter(bias)
        nn.init.zeros_(self.head.weight)

    def forward(self, channels: Float[Tensor, "b c h w"]) -> EdgeOutput:
        """Predict for images whose sides are multiples of `unet.MULTIPLE`.

        Map c s s + s i + j of `maps`, with s = `STRIDE`, holds what output c is at rows i, s + i, .. and columns
        j, s + j, ..; the last output is `wrong`.
        """
        out = F.pixel_shuffle(self.maps(channels), STRIDE)
        return EdgeOutput(out[:, :_STEPS], out[:, _STEPS])


# Every pixel continued from the place that the edge network chooses, and how probable it is that it is wrong.

_SURELY_WRONG = 20.0  # log odds where nothing can be continued
_STRIP = 512  # rows of the rectified image that the network is given at a time, which bounds its memory


@dataclass(frozen=True)
class Chosen:
    """Coordinates of every pixel that a surface can be continued to, in pattern pixels, and whether they hold."""

    coords: Coords
    wrong: Layer  # probability that they are more than a tenth of a period off


class EdgeChooser:
    """Applies the trained network to captures of one pattern."""

    def __init__(self, network: Maps, grid: GridPattern, drawn: tuple[DrawnGrid, ...]) -> None:
        self._network = network
        self._grid = grid
        self._drawn = drawn
        self._steps = steps()

    def choose(self, evidence: EdgeEvidence, rectified: RectifiedImage, turn: int) -> Chosen:
        """The best continuation of each pixel; `turn` are the quarter turns of the pattern in the rectified image."""
        view = edge_view(evidence, rectified, turn, self._grid, self._drawn)
        step, wrong = self._predict(view)
        linear = rectified.from_image[:, :2]
        affine = integer_centres(rectified.from_image)
        shape = (evidence.fitted.shape[1], evidence.fitted.shape[0])
        back = cv2.WARP_INVERSE_MAP
        nearest = np.asarray(cv2.warpAffine(step, affine, shape, flags=cv2.INTER_NEAREST | back), dtype=np.int64)
        border = (_SURELY_WRONG,) * 4
        odds = cv2.warpAffine(wrong, affine, shape, flags=cv2.INTER_LINEAR | back, borderValue=border)
        own = np.rint(np.linalg.solve(linear, self._steps.T).T).astype(np.int64)  # in pixels of the capture
        scale = float(np.sqrt(abs(np.linalg.det(linear)))) ** -1
        slope = slopes(evidence.fitted, self._grid.period, scale)
        coords = continued(evidence.fitted, slope, own[nearest])
        odds[np.isnan(coords[..., 0])] = _SURELY_WRONG
        return Chosen(coords, (1 / (1 + np.exp(-odds))).astype(np.float32))

    def _predict(self, view: EdgeView) -> tuple[Int[ndarray, "h w"], Layer]:
        """Index of the chosen step, and log odds of being wrong, for every pixel of the rectified image."""
        known = np.isfinite(view.fitted[..., 0])
        channels, rows = view.channels(), len(known)
        step, wrong = np.zeros(known.shape, dtype=np.int16), np.full(known.shape, _SURELY_WRONG, dtype=np.float32)
        for first in range(0, rows, _STRIP):
            begin, last = max(0, first - MARGIN), min(first + _STRIP, rows)
            strip = np.ascontiguousarray(channels[:, begin : min(last + MARGIN, rows)])
            here = self._network(strip)[(first - begin) // STRIDE :]
            _choose(here, known, self._steps, first, last, step, wrong)
        return step, wrong


@compiled
def _choose(
    maps: ndarray, known: ndarray, all_steps: ndarray, first: int, last: int, step: ndarray, wrong: ndarray
) -> None:
    """Fill rows `first` to `last` - 1: among the steps to places where something is known, the one scored highest.

    `maps` are those of `EdgeNetwork.maps`, (h, w, outputs), from row `first` on. Pixels without such a step are left.
    """
    h, w = known.shape
    count, parts = len(all_steps), STRIDE * STRIDE
    for row in range(first, last):
        for column in range(w):
            at = maps[(row - first) // STRIDE, column // STRIDE]
            part = (row - first) % STRIDE * STRIDE + column % STRIDE
            best, highest = -1, -np.inf
            for k in range(count):
                r, c = row + all_steps[k, 1], column + all_steps[k, 0]
                if 0 <= r < h and 0 <= c < w and known[r, c] and at[k * parts + part] > highest:
                    best, highest = k, at[k * parts + part]
            if best >= 0:
                step[row, column], wrong[row, column] = best, at[count * parts + part]


_WEIGHTS = Path(__file__).parent / "weights"
N = TypeVar("N", bound=nn.Module)


def load_unet() -> UNet:
    """The trained U-Net, in evaluation mode."""
    return _trained(UNet(), "unet").to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def load_graph_network() -> GraphNetwork:
    """The trained graph network, in evaluation mode."""
    return _trained(GraphNetwork(), "gcn")


def load_edge_network() -> EdgeNetwork:
    """The trained edge network, in evaluation mode."""
    return _trained(EdgeNetwork(), "edges").to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def _trained(network: N, name: str) -> N:
    network.load_state_dict(load_file(_WEIGHTS / f"{name}.safetensors"))
    return network.eval()


def weight_files() -> list[Path]:
    """All files of weights, sorted by name."""
    return sorted(_WEIGHTS.glob("*.safetensors"))
