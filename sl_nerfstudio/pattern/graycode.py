"""Gray-code stripes: a sequence of patterns from which each camera pixel is decoded without its neighbours.

The projector shows, in this order: white, black, the bits of the column (coarse to fine, each followed by its
inverse), then the bits of the row in the same way. Neighbouring cells differ in exactly one bit.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float32, Int, UInt8
from numpy import ndarray

from sl_nerfstudio.pattern.layout import PatternLayout, whole_number

HEAD = 2  # white and black


@dataclass(frozen=True)
class GrayCode(PatternLayout):
    """Description of a Gray-code sequence; cells are squares of `cell` pattern pixels."""

    kind: ClassVar[str] = "gray-code"
    description: ClassVar[str] = "a Gray-code sequence"
    w: int = 1920
    h: int = 1080
    cell: int = 2

    def __post_init__(self) -> None:
        """Raises ValueError for sizes that do not make a sequence."""
        if self.cell < 1 or min(self.w, self.h) < 2 * self.cell:
            raise ValueError(
                f"a Gray code needs at least 2 x 2 cells of 1 pixel or more, got {self.w} x {self.h} pixels "
                f"in cells of {self.cell}"
            )

    @property
    def columns(self) -> int:
        """Number of cells from left to right."""
        return -(-self.w // self.cell)

    @property
    def rows(self) -> int:
        """Number of cells from top to bottom."""
        return -(-self.h // self.cell)

    @property
    def bits(self) -> tuple[int, int]:
        """Number of bits of the column and of the row."""
        return (self.columns - 1).bit_length(), (self.rows - 1).bit_length()

    @property
    def images(self) -> int:
        """Number of patterns, and of photographs of each frame."""
        return HEAD + 2 * sum(self.bits)

    def bit_images(self, axis: int) -> list[tuple[int, int]]:
        """Index in the sequence of every bit of an axis (0: column, 1: row) and of its inverse, coarse to fine."""
        start = HEAD + (2 * self.bits[0] if axis else 0)
        return [(start + 2 * k, start + 2 * k + 1) for k in range(self.bits[axis])]

    def sequence(self) -> Iterator[UInt8[ndarray, "h w"]]:
        """All patterns in the order in which they are shown, 0 or 255."""
        white = np.full((self.h, self.w), 255, dtype=np.uint8)
        yield white
        yield np.zeros_like(white)
        for axis in (0, 1):
            for lit in self._stripes(axis):
                image = np.broadcast_to(lit if axis == 0 else lit[:, None], (self.h, self.w))
                yield np.where(image, white, np.uint8(0))
                yield np.where(image, np.uint8(0), white)

    def render(self, supersampling: int = 2) -> Float32[ndarray, "h w"]:
        """Mean of the finest stripes of both axes, in [0, 1].

        Stripes end where pixels end, so the mean over a pixel is the same for every `supersampling`.
        """
        x, y = (self._stripes(axis)[-1].astype(np.float32) for axis in (0, 1))
        return (x[None, :] + y[:, None]) / 2

    def fields(self) -> dict[str, Any]:
        """The side of a cell, and what each image of the sequence shows."""
        names = ["white", "black"]
        for axis, bits in zip("xy", self.bits, strict=True):
            names += [f"{axis} bit {bits - 1 - k}{inverse}" for k in range(bits) for inverse in ("", " inverse")]
        return {"cell": self.cell, "sequence": names}

    @classmethod
    def from_document(cls, document: dict[str, Any]) -> "GrayCode":
        """The sequence that a pattern.json describes."""
        layout = cls(*(whole_number(document, key) for key in ("w", "h", "cell")))
        names = layout.fields()["sequence"]
        if document.get("sequence", names) != names:
            raise ValueError(f"sequence does not list the {len(names)} images of a {layout.w} x {layout.h} Gray code")
        return layout

    def _stripes(self, axis: int) -> list[ndarray]:
        """Whether each pixel along an axis is lit, for every bit, coarse to fine."""
        cell = np.arange((self.w, self.h)[axis]) // self.cell
        code = gray(cell)
        return [code >> k & 1 == 1 for k in reversed(range(self.bits[axis]))]


def gray(index: Int[ndarray, "*n"]) -> Int[ndarray, "*n"]:
    """Gray codes of cell indices."""
    return index ^ (index >> 1)


def ungray(code: Int[ndarray, "*n"], bits: int) -> Int[ndarray, "*n"]:
    """Cell indices of Gray codes of `bits` bits."""
    index = code.copy()
    shift = 1
    while shift < bits:
        index ^= index >> shift
        shift *= 2
    return index
