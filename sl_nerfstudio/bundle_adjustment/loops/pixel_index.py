"""Which pixels of many images have a coordinate, and where it is among all that there are.

Only decoded pixels are stored: most of an image shows something else. A bit for each pixel says whether it has a
coordinate; with the number of those before each word of 64 bits, its place follows from a count of bits (rank:
Jacobson, "Space-efficient static trees and graphs", 1989).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt64
from numpy import ndarray

from sl_nerfstudio.compiled import compiled

WORD = 64  # bits
_ONE = np.uint64(1)
_TWO, _FOUR, _56 = np.uint64(2), np.uint64(4), np.uint64(56)
_FIVES, _THREES = np.uint64(0x5555555555555555), np.uint64(0x3333333333333333)
_FIFTEENS, _ONES = np.uint64(0x0F0F0F0F0F0F0F0F), np.uint64(0x0101010101010101)


@dataclass(frozen=True)
class PixelIndex:
    """Bits of all frames one after the other, rows first, the lowest of a word first; each row begins a word."""

    words: UInt64[ndarray, "words 2"]  # bits, number of pixels with a coordinate before: together, as they are read
    first: Int64[ndarray, "frames"]  # word of each frame
    widths: Int64[ndarray, "frames"]
    heights: Int64[ndarray, "frames"]

    @staticmethod
    def of(known: Sequence[UInt64[ndarray, "_h _words"]], widths: Sequence[int]) -> "PixelIndex":
        """From the words of each frame's rows (`packed`)."""
        counts = np.array([part.size for part in known], dtype=np.int64)
        words = np.empty((int(counts.sum()), 2), dtype=np.uint64)
        np.concatenate([part.ravel() for part in known], out=words[:, 0])
        _count_before(words)
        heights = np.array([len(part) for part in known], dtype=np.int64)
        return PixelIndex(words, np.cumsum(counts) - counts, np.array(widths, dtype=np.int64), heights)

    @property
    def arrays(self) -> tuple[ndarray, ndarray, ndarray, ndarray]:
        """For compiled loops."""
        return self.words, self.first, self.widths, self.heights

    def image(self, values: Float32[ndarray, "decoded 2"], frame: int) -> Float32[ndarray, "h w 2"]:
        """One frame, NaN where nothing is known."""
        w, h, first = self.widths[frame], self.heights[frame], self.first[frame]
        rows = self.words[first : first + h * words_of(w), 0].reshape(h, -1)
        known = np.unpackbits(rows.astype("<u8").view(np.uint8), axis=1, count=w, bitorder="little").view(np.bool_)
        out = np.full((h, w, 2), np.nan, dtype=np.float32)
        start = int(self.words[first, 1])
        out[known] = values[start : start + int(known.sum())]
        return out


def packed(known: Bool[ndarray, "h w"]) -> UInt64[ndarray, "h words"]:
    """The words of each row of an image."""
    h, w = known.shape
    padded = np.zeros((h, words_of(w) * WORD), dtype=np.bool_)
    padded[:, :w] = known
    return np.packbits(padded, axis=1, bitorder="little").view("<u8").astype(np.uint64)


@compiled
def words_of(width):
    """Words of a row."""
    return (width + WORD - 1) // WORD


# `row_word` is the first word of a pixel's row: first[frame] + row * words_of(width).


@compiled
def is_known(words, row_word, column):
    """Whether a pixel has a coordinate."""
    return (words[row_word + column // WORD, 0] >> np.uint64(column % WORD)) & _ONE == _ONE


@compiled
def place_of(words, row_word, column):
    """Number of a pixel's coordinate among all; -1 if it has none."""
    return next_place(words, row_word, column) if is_known(words, row_word, column) else -1


@compiled
def next_place(words, row_word, column):
    """Number of the first coordinate that is at a pixel or after it."""
    number, bit = row_word + column // WORD, np.uint64(column % WORD)
    return np.int64(words[number, 1]) + _bits_of(words[number, 0] & ((_ONE << bit) - _ONE))


@compiled
def known_pixels(words, first_word, width, height):
    """How many pixels of a frame, from its first word on, have a coordinate."""
    last_row, last = first_word + (height - 1) * words_of(width), width - 1
    return next_place(words, last_row, last) + is_known(words, last_row, last) - np.int64(words[first_word, 1])


@compiled
def _bits_of(x):
    """Number of bits that are set (Warren, Hacker's Delight, section 5-1)."""
    x = x - ((x >> _ONE) & _FIVES)
    x = (x & _THREES) + ((x >> _TWO) & _THREES)
    x = (x + (x >> _FOUR)) & _FIFTEENS
    return np.int64((x * _ONES) >> _56)


@compiled
def _count_before(words):
    total = 0
    for k in range(len(words)):
        words[k, 1] = total
        total += _bits_of(words[k, 0])
