"""Which of the inverse distances are tried where: in each tile of the image those around what was decoded near it."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Int32, Int64
from numpy import ndarray

from sl_nerfstudio.decoding.decoder import Mask
from sl_nerfstudio.matching.lines import UNKNOWN

TILE = 16  # side of a tile, pixels
FEWEST = 3  # inverse distances in a tile, so that a parabola can be laid through the best and its neighbours
MARGIN = 6  # inverse distances that are tried beyond those decoded, on either side
LEAST_DECODED = 0.7  # share of the pattern around a tile; where less is decoded, all inverse distances are tried


@dataclass(frozen=True)
class TriedRanges:
    """A range of the inverse distances for each tile; none where nothing can be matched."""

    first: Int32[ndarray, "a b"]  # number of the first
    count: Int32[ndarray, "a b"]  # how many: none, or at least `FEWEST`

    @cached_property
    def start(self) -> Int64[ndarray, "a b"]:
        """Place of each tile's values in an array of `cells`: one for each of its pixels and inverse distances.

        Tiles, rows, columns and inverse distances follow each other in this order.
        """
        size = self.count.astype(np.int64) * TILE**2
        return (np.cumsum(size) - size.ravel()).reshape(size.shape)

    @property
    def cells(self) -> int:
        """Values of all tiles together; tiles at the border count in full."""
        return int(self.count.sum(dtype=np.int64)) * TILE**2

    def part(self, rows: slice) -> "TriedRanges":
        """The ranges of some rows of tiles."""
        return TriedRanges(self.first[rows].copy(), self.count[rows].copy())

    @staticmethod
    def near(decoded: Int32[ndarray, "h w"], mask: Mask, count: int) -> "TriedRanges":
        """The ranges that are tried: around the numbers that were decoded in a tile and beside it, or all.

        `decoded` are the numbers of the inverse distances that were decoded, `UNKNOWN` where nothing was; `mask` shows
        where the pattern was seen. There are `count` inverse distances.
        """
        known = decoded != UNKNOWN
        low = -_greatest(np.where(known, -decoded, -count))
        high = _greatest(np.where(known, decoded, -1))
        read, seen = _sum(known), _sum(known | mask)
        near = (read > 0) & (read >= LEAST_DECODED * seen)
        first = np.where(near, low - MARGIN, 0).clip(0, max(count - FEWEST, 0))
        end = np.where(near, high + 1 + MARGIN, count).clip(first + min(FEWEST, count), count)
        tried = np.where(seen > 0, end - first, 0)
        return TriedRanges(first.astype(np.int32), tried.astype(np.int32))


def _tiles(values: ndarray, beyond: int) -> ndarray:
    """The pixels of each tile along the last axis; tiles at the border continue with a value."""
    h, w = values.shape
    a, b = -(-h // TILE), -(-w // TILE)
    full = np.full((a * TILE, b * TILE), beyond, dtype=values.dtype)
    full[:h, :w] = values
    return full.reshape(a, TILE, b, TILE).transpose(0, 2, 1, 3).reshape(a, b, TILE**2)


def _greatest(values: Int32[ndarray, "h w"]) -> Int32[ndarray, "a b"]:
    """The greatest value in a tile and the eight around it."""
    tiles = _tiles(values, int(values.min())).max(-1).astype(np.float32)
    return cv2.dilate(tiles, np.ones((3, 3))).astype(np.int32)


def _sum(values: Mask) -> Int32[ndarray, "a b"]:
    """How many pixels there are in a tile and the eight around it."""
    tiles = _tiles(values, False).sum(-1).astype(np.float32)
    return cv2.boxFilter(tiles, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT).astype(np.int32)
