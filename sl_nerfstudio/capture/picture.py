"""The picture in the preview: what the camera sees, what of it is decoded, what is still missing, and a few words."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8
from numpy import ndarray

_WIDTH, _HEIGHT = 960, 600  # most of the camera's image
_MAP = 300  # width of the map of the pattern
_GAP = 8
_LEAST_WIDTH = 640
_LINE = 24  # height of a line of text, pixels
_OPACITY = 0.65
_GREEN = 0.35  # as in the report of sl-process: x gives red, y gives blue
_ENOUGH = 3  # kept views of a node
_MAP_COLOURS = np.array([[70, 70, 70], [150, 60, 40], [200, 150, 50], [60, 170, 80]], dtype=np.uint8)  # 0, 1, 2, more


def pattern_colours(xy: Float32[ndarray, "*n 2"]) -> Float32[ndarray, "*n 3"]:
    """A colour in [0, 1] for every place of the pattern, whose coordinates go from 0 to 1."""
    return np.stack([xy[..., 0], np.full(xy.shape[:-1], _GREEN), xy[..., 1]], -1).astype(np.float32)


def reduced(image: UInt8[ndarray, "h w 3"]) -> tuple[UInt8[ndarray, "_h _w 3"], float]:
    """The image at the size of the preview, and the factor of its pixel coordinates."""
    factor = min(1.0, _WIDTH / image.shape[1], _HEIGHT / image.shape[0])
    size = max(1, round(image.shape[1] * factor)), max(1, round(image.shape[0] * factor))
    return (cv2.resize(image, size, interpolation=cv2.INTER_AREA) if factor < 1 else image.copy()), factor


def draw_nodes(
    picture: UInt8[ndarray, "h w 3"], uv: Float32[ndarray, "rows columns 2"], radius: float
) -> UInt8[ndarray, "h w 3"]:
    """The picture with a disc at every node that was found, in the colour of its place in the pattern."""
    rows, columns = uv.shape[:2]
    place = np.stack(np.meshgrid(np.arange(columns) / max(columns, 1), np.arange(rows) / max(rows, 1)), -1)
    colours = np.rint(255 * pattern_colours(place.astype(np.float32)))
    drawn = picture.copy()
    for row, column in np.argwhere(np.isfinite(uv[..., 0])):
        centre = tuple(int(v) for v in uv[row, column])
        cv2.circle(drawn, centre, max(1, round(radius)), tuple(map(float, colours[row, column])), -1, cv2.LINE_AA)
    return cv2.addWeighted(drawn, _OPACITY, picture, 1 - _OPACITY, 0)


def draw_pixels(
    picture: UInt8[ndarray, "h w 3"], xy: Float32[ndarray, "h w 2"], known: Bool[ndarray, "h w"]
) -> UInt8[ndarray, "h w 3"]:
    """The picture with every decoded pixel in the colour of its place in the pattern, from 0 to 1."""
    colours = 255 * pattern_colours(np.nan_to_num(xy))
    mixed = np.rint(_OPACITY * colours + (1 - _OPACITY) * picture).astype(np.uint8)
    return np.where(known[..., None], mixed, picture)


def draw_map(times_seen: Int[ndarray, "rows columns"]) -> UInt8[ndarray, "h w 3"]:
    """A map of the pattern: grey where no kept frame has seen it, red once, yellow twice, green more often."""
    cell = max(1, _MAP // max(times_seen.shape[1], 1))
    colours = _MAP_COLOURS[np.clip(times_seen, 0, _ENOUGH)]
    return np.repeat(np.repeat(colours, cell, 0), cell, 1)


def stack(pictures: Sequence[UInt8[ndarray, "_h _w 3"]]) -> UInt8[ndarray, "h w 3"]:
    """Pictures below each other, as wide as the widest."""
    width = max((picture.shape[1] for picture in pictures), default=0)
    return np.concatenate([np.pad(picture, ((0, _GAP), (0, width - picture.shape[1]), (0, 0))) for picture in pictures])


def compose(
    picture: UInt8[ndarray, "h w 3"], beside: Sequence[UInt8[ndarray, "_h _w 3"]], lines: Sequence[str]
) -> UInt8[ndarray, "H W 3"]:
    """The camera's image, smaller pictures beside it, and text below."""
    parts = [picture, *([stack(beside)] if beside else [])]
    height = max(part.shape[0] for part in parts)
    width = sum(part.shape[1] for part in parts) + _GAP * (len(parts) - 1)
    out = np.full((height + _LINE * (len(lines) + 1), max(width, _LEAST_WIDTH), 3), 30, dtype=np.uint8)
    left = 0
    for part in parts:
        out[: part.shape[0], left : left + part.shape[1]] = part
        left += part.shape[1] + _GAP
    for k, line in enumerate(lines):
        origin = (8, height + _LINE * (k + 1))
        cv2.putText(out, line, origin, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (235, 235, 235), 1, cv2.LINE_AA)
    return out


def share_seen(times_seen: Int[ndarray, "rows columns"], times: int = 1) -> float:
    """Share of the pattern that at least so many kept frames have seen."""
    return float((times_seen >= times).mean()) if times_seen.size else 0.0
