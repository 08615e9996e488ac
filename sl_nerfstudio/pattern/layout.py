"""Interface of patterns: size, picture, and description for pattern.json."""

import json
import math
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

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
        """Fields of pattern.json besides format, kind, image and size: JSON values."""

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
    """Read a whole number; errors are those of `number`."""
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


# What each image of a sequence of patterns shows, and in which order programs show them.
#
# A sequence numbers the pattern's cells along both axes with the bits of a Gray code, each with or without its
# inverse, or with shifted sines ("phase shifting"), or with both. The orders here are those of
#
# - OpenCV, `structured_light::GrayCodePattern` and its sample `cap_pattern`; procam-calibration takes them from
# there;
# - 3DUNDERWORLD-SLS, `GrayCode`, which is also the order of sl-pattern;
# - scan3d-capture of Moreno and Taubin, which numbers the cells from the middle of the code;
# - SLStudio, `CodecGrayCode` (no inverses) and `CodecPhaseShift3Unwrap` (three shifts of a sine, then three of a
# sine
#   that has one period).

_TEXT = re.compile(r"([xy]) (?:bit (\d{1,2})( inverse)?|phase (\d{1,2}) of (\d{1,2}), period (\d{1,6}(?:\.\d{1,9})?))")
FEWEST_STEPS = 3  # shifts that determine a sine
LONGEST = 200  # images of a sequence


@dataclass(frozen=True)
class ShownImage:
    """Content of one image: all white, all black, a bit of the cell's Gray code, or a shifted sine."""

    what: Literal["white", "black", "bit", "phase"]
    axis: int = 0  # 0: along x, 1: along y
    index: int = 0  # of a bit: 0 is the finest; of a sine: shifted by index / steps of its period towards larger x or y
    inverse: bool = False
    steps: int = 0
    period: float = 0.0  # pattern pixels

    def __str__(self) -> str:
        """The name in pattern.json: "white", "x bit 3 inverse", "y phase 0 of 4, period 16"."""
        if self.what == "bit":
            return f"{'xy'[self.axis]} bit {self.index}{' inverse' if self.inverse else ''}"
        if self.what == "phase":
            return f"{'xy'[self.axis]} phase {self.index} of {self.steps}, period {self.period:.9g}"
        return self.what

    @staticmethod
    def of(text: str) -> "ShownImage":
        """The inverse of `str`. Raises ValueError for anything else."""
        if text == "white" or text == "black":
            return ShownImage(text)
        found = _TEXT.fullmatch(text) if isinstance(text, str) else None
        if found is None:
            raise ValueError(
                f"{str(text)[:40]!r} is no image of a sequence (white, x bit 3 inverse, y phase 0 of 4, ..)"
            )
        axis, bit, inverse, shift, steps, period = found.groups()
        if bit is not None:
            return ShownImage("bit", "xy".index(axis), int(bit), inverse is not None)
        return ShownImage("phase", "xy".index(axis), int(shift), False, int(steps), float(period))


HEAD = (ShownImage("white"), ShownImage("black"))


def bits_with_inverses(axis: int, bits: int) -> list[ShownImage]:
    """The bits of an axis, coarse to fine, each followed by its inverse."""
    return [ShownImage("bit", axis, k, inverse) for k in reversed(range(bits)) for inverse in (False, True)]


def bits_alone(axis: int, bits: int) -> list[ShownImage]:
    """The bits of an axis, coarse to fine."""
    return [ShownImage("bit", axis, k) for k in reversed(range(bits))]


def phases(axis: int, steps: int, period: float) -> list[ShownImage]:
    """A sine, shifted by equal parts of its period."""
    return [ShownImage("phase", axis, k, False, steps, period) for k in range(steps)]


@dataclass(frozen=True)
class Scope:
    """Sizes that an order depends on."""

    size: tuple[int, int]  # (w, h) of the pattern
    bits: tuple[int, int]  # of the cell's column and row
    periods: tuple[float, float]  # of the finest sine along x and along y, pattern pixels


def _ours(scope: Scope) -> list[ShownImage]:
    return [*HEAD, *bits_with_inverses(0, scope.bits[0]), *bits_with_inverses(1, scope.bits[1])]


def _opencv(scope: Scope) -> list[ShownImage]:
    return [*bits_with_inverses(0, scope.bits[0]), *bits_with_inverses(1, scope.bits[1]), *HEAD]


def _scan3d(scope: Scope) -> list[ShownImage]:
    """Show as many bits of one axis as of the other: the finest of the longer axis are left out."""
    count = 2 * min(scope.bits)
    both = [bits_with_inverses(axis, scope.bits[axis])[:count] for axis in (0, 1)]
    return [*HEAD, *both[0], *both[1]]


def _alone(scope: Scope) -> list[ShownImage]:
    return [*HEAD, *bits_alone(0, scope.bits[0]), *bits_alone(1, scope.bits[1])]


def _phase_and_gray(scope: Scope) -> list[ShownImage]:
    both = [[*bits_alone(axis, scope.bits[axis]), *phases(axis, 4, scope.periods[axis])] for axis in (0, 1)]
    return [*HEAD, *both[0], *both[1]]


def _slstudio(scope: Scope) -> list[ShownImage]:
    both = [[*phases(axis, 3, scope.periods[axis]), *phases(axis, 3, float(scope.size[axis]))] for axis in (0, 1)]
    return [*both[0], *both[1]]


SequenceName = Literal[
    "sl-pattern", "opencv", "procam", "3dunderworld", "scan3d-capture", "no-inverses", "phase-gray", "slstudio",
    "slstudio-gray",
]  # fmt: skip
ORDERS: dict[str, Callable[[Scope], list[ShownImage]]] = {
    "sl-pattern": _ours,
    "opencv": _opencv,
    "procam": _opencv,
    "3dunderworld": _ours,
    "scan3d-capture": _scan3d,
    "no-inverses": _alone,
    "phase-gray": _phase_and_gray,
    "slstudio": _slstudio,
    "slstudio-gray": _alone,
}
"""By the name for --sequence. Some programs share an order."""
CENTRED = ("scan3d-capture",)
"""Programs that number the cells so that the middle of the pattern has the middle of all codes."""


def order_names(shown: Sequence[ShownImage], scope: Scope, centred: bool = False) -> list[str]:
    """Names of the programs that show exactly this; empty for an order of its own."""
    orders = {name: order for name, order in ORDERS.items() if (name in CENTRED) == centred}
    return [name for name, order in orders.items() if tuple(order(scope)) == tuple(shown)]


def check_shown(shown: Sequence[ShownImage], bits: tuple[int, int], size: tuple[int, int]) -> None:
    """Raise ValueError unless the images determine the column and the row of every pixel of the pattern."""
    listed = set(shown)
    if len(listed) != len(shown):
        twice = next(item for item in shown if list(shown).count(item) > 1)
        raise ValueError(f"sequence lists {twice} more than once")
    if len(shown) > LONGEST:
        raise ValueError(f"sequence lists {len(shown)} images, more than {LONGEST}")
    with_bits = any(item.what == "bit" for item in shown)
    if with_bits and not set(HEAD) <= listed:
        raise ValueError("sequence lists no image white and no image black, against which bits are read")
    inverses = any(item.inverse for item in shown)
    for axis, (name, other) in enumerate(("xy", "yx")):
        own = [item for item in shown if item.what in ("bit", "phase") and item.axis == axis]
        if not own:
            raise ValueError(
                f"sequence shows {'columns' if other == 'x' else 'rows'} only ({other}): the projector may be "
                "anywhere, and its pose follows only from both coordinates of each point; show the other stripes, too"
            )
        _check_bits([item for item in own if item.what == "bit"], name, bits[axis], inverses)
        _check_phases([item for item in own if item.what == "phase"], name)
        longest = max((item.period for item in own if item.what == "phase"), default=0.0)
        if longest < size[axis] and not any(item.what == "bit" for item in own):
            raise ValueError(f"sequence shows {name} only modulo {longest:g} pixels, of {size[axis]}")


def _check_bits(own: Sequence[ShownImage], axis: str, bits: int, inverses: bool) -> None:
    found = {(item.index, item.inverse) for item in own}
    finest = min((index for index, _ in found), default=0)  # finer ones need not be shown
    shown = range(min(finest, bits - 1), bits)
    expected = {(k, inverse) for k in shown for inverse in ((False, True) if inverses else (False,))}
    if own and found != expected:
        wrong = sorted(str(ShownImage("bit", "xy".index(axis), *item)) for item in found ^ expected)
        raise ValueError(f"sequence has {bits} bits of {axis}; missing or too many: {', '.join(wrong[:6])}")


def _check_phases(own: Sequence[ShownImage], axis: str) -> None:
    for steps, period in sorted({(item.steps, item.period) for item in own}):
        shifts = {item.index for item in own if (item.steps, item.period) == (steps, period)}
        if steps < FEWEST_STEPS or period < 2 or shifts != set(range(steps)):
            raise ValueError(
                f"the sines of {axis} with period {period:g} must have {FEWEST_STEPS} or more steps, all listed, and a "
                "period of 2 pixels or more"
            )
