"""Gray-code stripes: a sequence of patterns from which each camera pixel is decoded without its neighbours.

Unless another order is given, the projector shows white, black, the bits of the column (coarse to fine, each followed
by its inverse), then the bits of the row in the same way. Neighbouring cells differ in exactly one bit.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float32, Float64, Int, UInt8
from numpy import ndarray

from sl_nerfstudio.pattern.layout import (
    CENTRED,
    ORDERS,
    PatternLayout,
    Scope,
    SequenceName,
    ShownImage,
    check_shown,
    order_names,
    whole_number,
)


@dataclass(frozen=True)
class GrayCode(PatternLayout):
    """Description of a Gray-code sequence; cells are squares of `cell` pattern pixels."""

    kind: ClassVar[str] = "gray-code"
    description: ClassVar[str] = "a Gray-code sequence"
    w: int = 1920
    h: int = 1080
    cell: int = 2
    shown: tuple[ShownImage, ...] = ()
    """What each image shows, in the order of projection; empty: the order of sl-pattern."""
    centred: bool = False
    """Cells are numbered so that the middle of the pattern has the middle of all codes; otherwise from 0."""

    def __post_init__(self) -> None:
        """Raises ValueError for sizes that do not make a sequence, and for images that do not determine the cell."""
        if self.cell < 1 or min(self.w, self.h) < 2 * self.cell:
            raise ValueError(
                f"a Gray code needs at least 2 x 2 cells of 1 pixel or more, got {self.w} x {self.h} pixels "
                f"in cells of {self.cell}"
            )
        if not self.shown:
            object.__setattr__(self, "shown", tuple(ORDERS["sl-pattern"](self.scope)))
        check_shown(self.shown, self.bits, (self.w, self.h))
        if not any(self._free_codes):  # then both numberings are one
            object.__setattr__(self, "centred", False)

    @staticmethod
    def in_order(
        name: SequenceName, w: int, h: int, cell: int = 1, periods: tuple[float, float] | None = None
    ) -> "GrayCode":
        """The sequence of a program. `periods`, of sines along x and y in pattern pixels, is by default `cell`.

        Raises ValueError for sizes that do not make a sequence.
        """
        scope = GrayCode(w, h, cell).scope
        shown = tuple(ORDERS[name](Scope(scope.size, scope.bits, periods or scope.periods)))
        return GrayCode(w, h, cell, shown, name in CENTRED)

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
        return len(self.shown)

    @property
    def order(self) -> str:
        """Names of the programs that use this order, or "its own"."""
        return ", ".join(order_names(self.shown, self.scope, self.centred)) or "its own"

    def place(self, shown: ShownImage) -> int | None:
        """Index in the sequence of the image that shows this; None if there is none."""
        return self.shown.index(shown) if shown in self.shown else None

    def bit_images(self, axis: int) -> list[tuple[int, int | None]]:
        """Index in the sequence of every bit of an axis (0: column, 1: row) and of its inverse, coarse to fine.

        The inverse is None if the sequence has none. The list is empty if the axis has sines alone.
        """
        bits = (ShownImage("bit", axis, k) for k in reversed(range(self.bits[axis])))
        return [(self.shown.index(bit), self.place(replace(bit, inverse=True))) for bit in bits if bit in self.shown]

    def sines(self, axis: int) -> list[tuple[int, float]]:
        """Steps and period (pattern pixels) of every sine along an axis, the longest first."""
        found = {(item.steps, item.period) for item in self.shown if item.what == "phase" and item.axis == axis}
        return sorted(found, key=lambda sine: -sine[1])

    def sine_images(self, axis: int, steps: int, period: float) -> list[int]:
        """Index in the sequence of every shift of a sine."""
        return [self.shown.index(ShownImage("phase", axis, k, False, steps, period)) for k in range(steps)]

    def sequence(self) -> Iterator[UInt8[ndarray, "h w"]]:
        """All patterns in the order in which they are shown, 0 to 255."""
        for shown in self.shown:
            values = np.rint(255 * self._values(shown)).astype(np.uint8)
            along = values if shown.axis == 0 else values[:, None]
            yield np.array(np.broadcast_to(along, (self.h, self.w)))

    def render(self, supersampling: int = 2) -> Float32[ndarray, "h w"]:
        """Mean of the finest stripes of both axes, in [0, 1].

        Stripes end where pixels end, so the mean over a pixel is the same for every `supersampling`.
        """
        x, y = (self._values(self.finest(axis)).astype(np.float32) for axis in (0, 1))
        return (x[None, :] + y[:, None]) / 2

    def finest(self, axis: int) -> ShownImage:
        """The finest stripes along an axis: those of the last bit, otherwise the shortest sine."""
        bits = self.bit_images(axis)
        if bits:
            return self.shown[bits[-1][0]]
        steps, period = self.sines(axis)[-1]
        return ShownImage("phase", axis, 0, False, steps, period)

    def fields(self) -> dict[str, Any]:
        """The side of a cell, and what each image of the sequence shows."""
        centred = {"centred": True} if self.centred else {}
        return {"cell": self.cell, **centred, "sequence": [str(shown) for shown in self.shown]}

    @classmethod
    def from_document(cls, document: dict[str, Any]) -> "GrayCode":
        """The sequence that a pattern.json describes; without a list of images, in the order of sl-pattern."""
        w, h, cell = (whole_number(document, key) for key in ("w", "h", "cell"))
        centred = document.get("centred", False)
        if not isinstance(centred, bool):
            raise ValueError("centred is neither true nor false")
        if "sequence" not in document:
            return cls(w, h, cell, centred=centred)
        names = document["sequence"]
        if not isinstance(names, list) or not names:
            raise ValueError("sequence is no list of what the images show")
        return cls(w, h, cell, tuple(ShownImage.of(name) for name in names), centred)

    def first_code(self, axis: int) -> int:
        """Number of the first cell of an axis."""
        return self._free_codes[axis] // 2 if self.centred else 0

    @property
    def _free_codes(self) -> tuple[int, int]:
        """Codes of each axis that no cell has."""
        return (1 << self.bits[0]) - self.columns, (1 << self.bits[1]) - self.rows

    @property
    def scope(self) -> Scope:
        """Sizes that the orders of other programs depend on."""
        x, y = (min((sine[1] for sine in self.sines(axis)), default=float(max(self.cell, 2))) for axis in (0, 1))
        return Scope((self.w, self.h), self.bits, (x, y))

    def _values(self, shown: ShownImage) -> Float64[ndarray, "n"]:
        """Brightness in [0, 1] of each pixel along the axis of an image."""
        pixel = np.arange((self.w, self.h)[shown.axis])
        if shown.what == "phase":
            return 0.5 + 0.5 * np.cos(2 * np.pi * (pixel / shown.period - shown.index / shown.steps))
        if shown.what == "bit":
            code = gray(pixel // self.cell + self.first_code(shown.axis))
            return ((code >> shown.index & 1) == (0 if shown.inverse else 1)).astype(np.float64)
        return np.full(len(pixel), 1.0 if shown.what == "white" else 0.0)


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
