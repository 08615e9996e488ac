"""A few of the pixels of a sequence's photographs: a coarse grid, and whole lines that cross the stripes' borders."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int64
from numpy import ndarray

from sl_nerfstudio.decoding.graycode.photographs import Image
from sl_nerfstudio.scan.images import as_grey

_GRID = 320  # samples along the longer side of an image
_LINES = 48  # rows, and as many columns
_LONGEST_GAP = 8  # pixels on a line between two that count as neighbours


@dataclass(frozen=True)
class Samples:
    """Intensities in [0, 1] of n images at the same pixels."""

    grid: Float32[ndarray, "n h w"]
    lines: Float32[ndarray, "n m"]  # rows and columns, one after the other
    line: Int64[ndarray, "m"]  # number of each pixel's line
    rows: int  # number of lines that are rows; the others are columns

    def neighbours(self, certain: Bool[ndarray, "m"]) -> tuple[Int64[ndarray, "p"], Int64[ndarray, "p"]]:
        """Pairs of successive certain pixels on a line, at most a few uncertain ones apart."""
        known = np.flatnonzero(certain)
        near = (np.diff(known) <= _LONGEST_GAP) & (np.diff(self.line[known]) == 0)
        return known[:-1][near], known[1:][near]


def take_samples(images: Sequence[Image]) -> Samples:
    """Samples of images that all have one size."""
    h, w = images[0].shape[:2]
    step = max(1, max(h, w) // _GRID)
    rows, columns = (np.unique(np.linspace(0, size - 1, _LINES + 2).astype(int)[1:-1]) for size in (h, w))
    grid, lines = [], []
    for image in images:
        grid.append(as_grey(np.ascontiguousarray(image[::step, ::step])))
        along = np.concatenate([image[rows].reshape(-1, *image.shape[2:]),
                                image[:, columns].swapaxes(0, 1).reshape(-1, *image.shape[2:])])  # fmt: skip
        lines.append(as_grey(along[:, None])[:, 0])
    number = np.concatenate([np.repeat(np.arange(len(rows)), w), len(rows) + np.repeat(np.arange(len(columns)), h)])
    return Samples(np.stack(grid), np.stack(lines), number.astype(np.int64), len(rows))
