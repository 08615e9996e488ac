"""What the edge network sees: the image, the coordinates, and how the pattern would look if surfaces were continued.

All is in the rectified image, and coordinates are those of the turned pattern, so that its lines are nearly upright.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray

from sl_nerfstudio.decoding.grid.channels import network_channels
from sl_nerfstudio.decoding.grid.drawn_grid import DrawnGrid
from sl_nerfstudio.decoding.grid.edges.continuation import continued, slopes, steps
from sl_nerfstudio.decoding.grid.edges.evidence import Evidence
from sl_nerfstudio.decoding.grid.rectify import RectifiedImage, integer_centres
from sl_nerfstudio.decoding.grid.turned import from_pattern, to_pattern
from sl_nerfstudio.decoding.regions import torn
from sl_nerfstudio.pattern.grid import GridPattern

CHANNELS = 23
_TEAR = 0.35  # periods between neighbouring pixels
_LARGEST_RATIO = 2.0
_LARGEST_MOVE = 0.3  # periods
_MOVE_SCALE = 5.0  # so that moves are about as large as the other channels
_SEEN_FROM = 9  # pixels: surfaces are continued over this distance to compare them with the image


@dataclass(frozen=True)
class EdgeView:
    """The evidence of a capture in its rectified image; coordinates in periods, NaN where unknown."""

    measured: Float[ndarray, "7 h w"]  # contrast, brightness, pattern sharp and soft, agreement, ratio, probability
    fitted: Float32[ndarray, "h w 2"]
    read: Float32[ndarray, "h w 2"]
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
        parts = [self.measured, known[None], phase * known, np.moveaxis(move, -1, 0), torn(self.fitted, _TEAR)[None]]
        return np.concatenate([*parts, self.continued]).astype(np.float32)


def edge_view(
    evidence: Evidence, rectified: RectifiedImage, turn: int, grid: GridPattern, drawn: tuple[DrawnGrid, ...]
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
    fitted: Float32[ndarray, "h w 2"],
    slope: Float32[ndarray, "h w 2 2"],
    step: ndarray,
    drawn: DrawnGrid,
    grid: GridPattern,
    turn: int,
) -> Float32[ndarray, "h w"]:
    """The pattern where every pixel is continued from the place one step away; 0 where nothing is known there."""
    coords = continued(fitted, slope, np.broadcast_to(step, fitted.shape))
    return np.where(np.isfinite(coords[..., 0]), drawn.at(to_pattern(coords, grid, turn))[..., 0], np.float32(0))


def _moved(layer: Float32[ndarray, "h w *k"], rectified: RectifiedImage, flags: int) -> Float32[ndarray, "a b *k"]:
    size = rectified.image.shape[::-1]
    return cv2.warpAffine(layer, integer_centres(rectified.from_image), size, flags=flags)


def moved_coords(
    coords: Float32[ndarray, "h w 2"], rectified: RectifiedImage, tear: float = _TEAR
) -> Float32[ndarray, "a b 2"]:
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
