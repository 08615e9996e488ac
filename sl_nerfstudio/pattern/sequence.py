"""What each image of a sequence of patterns shows, and in which order programs show them.

A sequence numbers the pattern's cells along both axes with the bits of a Gray code, each with or without its inverse,
or with shifted sines ("phase shifting"), or with both. The orders here are those of

- OpenCV, `structured_light::GrayCodePattern` and its sample `cap_pattern`; procam-calibration takes them from there;
- 3DUNDERWORLD-SLS, `GrayCode`, which is also the order of sl-pattern;
- SLStudio, `CodecGrayCode` (no inverses) and `CodecPhaseShift3Unwrap` (three shifts of a sine, then three of a sine
  that has one period).
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

_TEXT = re.compile(r"([xy]) (?:bit (\d{1,2})( inverse)?|phase (\d{1,2}) of (\d{1,2}), period (\d{1,6}(?:\.\d{1,9})?))")
FEWEST_STEPS = 3  # shifts that determine a sine
LONGEST = 200  # images of a sequence


@dataclass(frozen=True)
class Shown:
    """What one image shows: all white, all black, a bit of the cell's Gray code, or a shifted sine."""

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
    def of(text: str) -> "Shown":
        """The inverse of `str`. Raises ValueError for anything else."""
        if text == "white" or text == "black":
            return Shown(text)
        found = _TEXT.fullmatch(text) if isinstance(text, str) else None
        if found is None:
            raise ValueError(
                f"{str(text)[:40]!r} is no image of a sequence (white, x bit 3 inverse, y phase 0 of 4, ..)"
            )
        axis, bit, inverse, shift, steps, period = found.groups()
        if bit is not None:
            return Shown("bit", "xy".index(axis), int(bit), inverse is not None)
        return Shown("phase", "xy".index(axis), int(shift), False, int(steps), float(period))


HEAD = (Shown("white"), Shown("black"))


def bits_with_inverses(axis: int, bits: int) -> list[Shown]:
    """The bits of an axis, coarse to fine, each followed by its inverse."""
    return [Shown("bit", axis, k, inverse) for k in reversed(range(bits)) for inverse in (False, True)]


def bits_alone(axis: int, bits: int) -> list[Shown]:
    """The bits of an axis, coarse to fine."""
    return [Shown("bit", axis, k) for k in reversed(range(bits))]


def phases(axis: int, steps: int, period: float) -> list[Shown]:
    """A sine, shifted by equal parts of its period."""
    return [Shown("phase", axis, k, False, steps, period) for k in range(steps)]


@dataclass(frozen=True)
class Scope:
    """What an order depends on."""

    size: tuple[int, int]  # (w, h) of the pattern
    bits: tuple[int, int]  # of the cell's column and row
    periods: tuple[float, float]  # of the finest sine along x and along y, pattern pixels


def _ours(scope: Scope) -> list[Shown]:
    return [*HEAD, *bits_with_inverses(0, scope.bits[0]), *bits_with_inverses(1, scope.bits[1])]


def _opencv(scope: Scope) -> list[Shown]:
    return [*bits_with_inverses(0, scope.bits[0]), *bits_with_inverses(1, scope.bits[1]), *HEAD]


def _alone(scope: Scope) -> list[Shown]:
    return [*HEAD, *bits_alone(0, scope.bits[0]), *bits_alone(1, scope.bits[1])]


def _phase_and_gray(scope: Scope) -> list[Shown]:
    both = [[*bits_alone(axis, scope.bits[axis]), *phases(axis, 4, scope.periods[axis])] for axis in (0, 1)]
    return [*HEAD, *both[0], *both[1]]


def _slstudio(scope: Scope) -> list[Shown]:
    both = [[*phases(axis, 3, scope.periods[axis]), *phases(axis, 3, float(scope.size[axis]))] for axis in (0, 1)]
    return [*both[0], *both[1]]


SequenceName = Literal[
    "sl-pattern", "opencv", "procam", "3dunderworld", "no-inverses", "phase-gray", "slstudio", "slstudio-gray"
]
ORDERS: dict[str, Callable[[Scope], list[Shown]]] = {
    "sl-pattern": _ours,
    "opencv": _opencv,
    "procam": _opencv,
    "3dunderworld": _ours,
    "no-inverses": _alone,
    "phase-gray": _phase_and_gray,
    "slstudio": _slstudio,
    "slstudio-gray": _alone,
}
"""By the name for --sequence. Some programs share an order."""


def order_names(shown: Sequence[Shown], scope: Scope) -> list[str]:
    """Names of the programs that show exactly this; empty for an order of its own."""
    return [name for name, order in ORDERS.items() if tuple(order(scope)) == tuple(shown)]


def check_shown(shown: Sequence[Shown], bits: tuple[int, int], size: tuple[int, int]) -> None:
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


def _check_bits(own: Sequence[Shown], axis: str, bits: int, inverses: bool) -> None:
    expected = {(k, inverse) for k in range(bits) for inverse in ((False, True) if inverses else (False,))}
    found = {(item.index, item.inverse) for item in own}
    if own and found != expected:
        wrong = sorted(str(Shown("bit", "xy".index(axis), *item)) for item in found ^ expected)
        raise ValueError(f"sequence has {bits} bits of {axis}; missing or too many: {', '.join(wrong[:6])}")


def _check_phases(own: Sequence[Shown], axis: str) -> None:
    for steps, period in sorted({(item.steps, item.period) for item in own}):
        shifts = {item.index for item in own if (item.steps, item.period) == (steps, period)}
        if steps < FEWEST_STEPS or period < 2 or shifts != set(range(steps)):
            raise ValueError(
                f"the sines of {axis} with period {period:g} must have {FEWEST_STEPS} or more steps, all listed, and a "
                "period of 2 pixels or more"
            )
