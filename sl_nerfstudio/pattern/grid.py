"""The coded grid: vertical and horizontal line segments with small gaps at the crossings.

Node (i, j) of the grid (row, column) lies at pattern pixel (x0 + j * period, y0 + i * period). Each node shifts the
ends of the segments that meet there, and a segment runs straight from one shifted end to the other. So the lines bend
a little, but the nodes stay on the regular grid.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float, Float32, Int8
from numpy import ndarray

from sl_nerfstudio.pattern.codes import SYMBOL_NAMES, SYMBOLS, WINDOW, code_array, hamming_margins, is_generated
from sl_nerfstudio.pattern.layout import Lattice, PatternLayout, number, whole_number

# Offsets, in half gaps, of the segments that meet at a node, by symbol: left, right (y down); above, below (x right).
_OFFSETS = np.array(
    [[0, 0, 0, 0], [-1, 1, 0, 0], [1, -1, 0, 0], [0, 0, 1, -1], [0, 0, -1, 1]],
    dtype=np.float64,
)
MAX_NODES = 200  # a side
MAX_PIXELS = 100_000_000
_BAND = 16  # rows that are drawn at a time: they fit into the processor's cache
_LENGTHS = ("period", "line_width", "gap", "dark")


@dataclass(frozen=True, eq=False)
class GridPattern(PatternLayout):
    """Description of a coded grid; lengths in pattern pixels."""

    kind: ClassVar[str] = "grid"
    description: ClassVar[str] = "a coded grid"
    w: int = 800
    h: int = 800
    period: float = 20.0
    line_width: float = 4.0
    gap: float = 6.0
    dark: float = 0.0  # intensity between the lines; the lines have 1
    seed: int = 0
    codes: Int8[ndarray, "rows columns"] | None = None  # None: generated from the seed

    def __post_init__(self) -> None:
        """Check the lengths and fill in the codes. Raises ValueError for a grid that cannot be drawn."""
        if not 0 < self.line_width < self.period or not 0 <= self.gap < self.period - self.line_width:
            raise ValueError(
                f"a grid needs 0 < line_width < period and 0 <= gap < period - line_width, got "
                f"line_width {self.line_width:g}, gap {self.gap:g}, period {self.period:g}"
            )
        if not 0 <= self.dark < 1:
            raise ValueError(f"dark is {self.dark:g}; the lines have 1, so it must be from 0 to less than 1")
        if self.w * self.h > MAX_PIXELS or max(self.w, self.h) > MAX_NODES * self.period:
            raise ValueError(f"a {self.w} x {self.h} pattern of period {self.period:g} is too large")
        rows, columns = int(self.h // self.period), int(self.w // self.period)
        if min(rows, columns) < 3:
            raise ValueError(f"a {self.w} x {self.h} pattern of period {self.period:g} has fewer than 3 x 3 nodes")
        codes = code_array(rows, columns, self.seed) if self.codes is None else np.asarray(self.codes, dtype=np.int8)
        if codes.shape != (rows, columns):
            raise ValueError(f"the code array must be {rows} x {columns}, got {codes.shape[0]} x {codes.shape[1]}")
        object.__setattr__(self, "codes", codes)

    @property
    def rows(self) -> int:
        """Number of nodes from top to bottom."""
        return int(self.h // self.period)

    @property
    def columns(self) -> int:
        """Number of nodes from left to right."""
        return int(self.w // self.period)

    @property
    def x0(self) -> float:
        """x of the leftmost nodes; the grid is centred in the pattern."""
        return (self.w - (self.columns - 1) * self.period) / 2

    @property
    def y0(self) -> float:
        """y of the topmost nodes."""
        return (self.h - (self.rows - 1) * self.period) / 2

    @cached_property
    def margins(self) -> tuple[int, int]:
        """In how many of 9 symbols 3 x 3 windows differ at least: upright, and where the camera may roll."""
        return hamming_margins(np.asarray(self.codes))

    @property
    def lattice(self) -> Lattice:
        """The nodes of the grid."""
        return Lattice(self.period, self.x0, self.y0, self.rows, self.columns)

    def nodes(self) -> Float[ndarray, "rows columns 2"]:
        """Pattern pixel (x, y) of every node."""
        x = self.x0 + self.period * np.arange(self.columns)
        y = self.y0 + self.period * np.arange(self.rows)
        return np.stack(np.meshgrid(x, y), -1)

    def intensity(self, uv: Float[ndarray, "*n 2"]) -> Float[ndarray, "*n"]:
        """Brightness at pattern pixels (x, y): 1 on a line, `dark` between, with edges one pixel soft."""
        x = (uv[..., 0] - self.x0) / self.period
        y = (uv[..., 1] - self.y0) / self.period
        offset_y, offset_x = self._line_offsets
        across_h = (y - np.rint(y)) * self.period - _along(offset_y, y, x)
        across_v = (x - np.rint(x)) * self.period - _along(offset_x.transpose(1, 0, 2), x, y)
        distance = np.minimum(np.abs(across_h), np.abs(across_v))
        light = np.clip(self.line_width / 2 + 0.5 - distance, 0.0, 1.0)
        return self.dark + (1 - self.dark) * light

    def render(self, supersampling: int = 2) -> Float32[ndarray, "h w"]:
        """The pattern as an image in [0, 1]; each pixel is the mean of `supersampling`^2 samples."""
        step = (np.arange(supersampling) + 0.5) / supersampling
        image = np.zeros((self.h, self.w))
        for top in range(0, self.h, _BAND):
            band = image[top : top + _BAND]
            y = top + np.arange(len(band))
            for dy in step:
                for dx in step:
                    band += self.intensity(np.stack(np.meshgrid(np.arange(self.w) + dx, y + dy), -1))
        return (image / supersampling**2).astype(np.float32)

    def fields(self) -> dict[str, Any]:
        """Lengths, codes, and what the codes can correct."""
        return {
            **{key: getattr(self, key) for key in (*_LENGTHS, "seed", "x0", "y0", "rows", "columns")},
            "symbols": list(SYMBOL_NAMES),
            "window": WINDOW,
            "hamming_margin": self.margins[0],
            "hamming_margin_turned": self.margins[1],
            "codes": np.asarray(self.codes).tolist(),
        }

    @classmethod
    def from_document(cls, document: dict[str, Any]) -> "GridPattern":
        """The grid that a pattern.json describes."""
        numbers = {key: number(document, key) for key in _LENGTHS}
        w, h, seed = (whole_number(document, key) for key in ("w", "h", "seed"))
        codes = np.array(document["codes"])
        if codes.dtype.kind != "i" or codes.ndim != 2 or codes.min(initial=0) < 0 or codes.max(initial=0) >= SYMBOLS:
            raise ValueError(f"codes must be rows of whole numbers from 0 to {SYMBOLS - 1}")
        pattern = cls(w=w, h=h, seed=seed, codes=codes.astype(np.int8), **numbers)
        for key in ("rows", "columns", "x0", "y0"):
            if number(document, key) != getattr(pattern, key):
                raise ValueError(f"{key} is {document[key]}, but w, h and period make it {getattr(pattern, key):g}")
        margins = (whole_number(document, key) for key in ("hamming_margin", "hamming_margin_turned"))
        if not is_generated(np.asarray(pattern.codes), seed, *margins):
            raise ValueError(
                f"codes are not those of seed {seed}: with other symbols than those projected, places are confused"
            )
        return pattern

    @cached_property
    def _line_offsets(self) -> tuple[Float[ndarray, "rows s 2"], Float[ndarray, "r columns 2"]]:
        """Offsets at both ends of each segment: segment k of a line runs from node k - 1 to node k.

        At the border of the pattern, where one of the two nodes does not exist, both ends have the other's offset.
        """
        left, right, above, below = np.moveaxis(_OFFSETS[self.codes] * self.gap / 2, -1, 0)
        start = np.concatenate([left[:, :1], right], 1)
        end = np.concatenate([left, right[:, -1:]], 1)
        top = np.concatenate([above[:1], below], 0)
        bottom = np.concatenate([above, below[-1:]], 0)
        return np.stack([start, end], -1), np.stack([top, bottom], -1)


def _along(
    offsets: Float[ndarray, "lines segments 2"], across: Float[ndarray, "*n"], along: Float[ndarray, "*n"]
) -> Float[ndarray, "*n"]:
    """Offset of the nearest line at a point; `across` and `along` count periods from the first node."""
    line = np.clip(np.rint(across), 0, offsets.shape[0] - 1).astype(np.int64)
    segment = np.clip(np.floor(along) + 1, 0, offsets.shape[1] - 1).astype(np.int64)
    t = np.clip(along - (segment - 1), 0.0, 1.0)
    ends = offsets[line, segment]
    return (1 - t) * ends[..., 0] + t * ends[..., 1]
