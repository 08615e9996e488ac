"""What every kind of pattern offers: its size, a picture of it, and its description for pattern.json."""

import json
import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

from jaxtyping import Float32
from numpy import ndarray

FORMAT = 1  # of pattern.json
MAX_NUMBER = 2**53  # larger ones are not exact as float64


@dataclass(frozen=True)
class Lattice:
    """Regular nodes of a pattern: node (i, j), row and column, lies at (x0 + j * period, y0 + i * period)."""

    period: float  # pattern pixels, as x0 and y0
    x0: float
    y0: float
    rows: int
    columns: int


class PatternLayout(ABC):
    """The description of a projected pattern: a decoder needs nothing else to know the pattern's codes.

    A new kind is a frozen dataclass that derives from this one, and an entry in `files.LAYOUTS`.
    """

    kind: ClassVar[str]  # "kind" in pattern.json
    description: ClassVar[str]  # in messages, with its article: "a coded grid"
    w: int  # pattern pixels
    h: int

    @property
    def lattice(self) -> Lattice | None:
        """The nodes at which the pattern carries its code; None for a pattern that is not made of nodes."""
        return None

    @abstractmethod
    def render(self, supersampling: int = 2) -> Float32[ndarray, "h w"]:
        """One image in [0, 1] that varies in x and in y; each pixel is the mean of `supersampling`^2 samples."""

    @abstractmethod
    def fields(self) -> dict[str, Any]:
        """What pattern.json holds besides format, kind, image and size: JSON values."""

    @classmethod
    @abstractmethod
    def from_document(cls, document: dict[str, Any]) -> "PatternLayout":
        """The layout that a pattern.json describes.

        Raises KeyError for a missing field, TypeError, ValueError or IndexError for values that make no pattern.
        `number` and `whole_number` read the fields.
        """

    def encode(self, image: str = "pattern.png") -> bytes:
        """The text of pattern.json; `image` is the file beside it that shows the pattern."""
        head = {"sl_pattern": FORMAT, "kind": self.kind, "image": image, "w": self.w, "h": self.h}
        return _encode({**head, **self.fields()})


def number(document: dict[str, Any], key: str) -> float:
    """A finite number of a pattern.json. Raises KeyError if it is missing, ValueError for anything else."""
    value = document[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= MAX_NUMBER:
        raise ValueError(f"{key} is {str(value)[:20]}, not a number of reasonable size")
    return float(value)


def whole_number(document: dict[str, Any], key: str) -> int:
    """The same for whole numbers."""
    value = number(document, key)
    if value != math.floor(value):
        raise ValueError(f"{key} is {value:g}, not a whole number")
    return int(value)


def _encode(document: dict[str, Any]) -> bytes:
    """Indented JSON; arrays of arrays are written at the end, one row per line."""
    tables = {key: value for key, value in document.items() if _is_table(value)}
    text = json.dumps({key: value for key, value in document.items() if key not in tables}, indent=1)[:-2]
    for key, table in tables.items():
        rows = ",\n  ".join(json.dumps(row, separators=(",", ":")) for row in table)
        text += f',\n "{key}": [\n  {rows}\n ]'
    return f"{text}\n}}\n".encode()


def _is_table(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(row, list) for row in value)
