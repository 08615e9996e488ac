"""Errors that a user can fix: their text is the whole message, and command lines print it without a traceback."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

_SHOWN = 3  # faults of one kind that are written out; of more, only the first is, and some of the others are named
_NAMED = 4
_LONGEST = 200  # characters of a line of another library


class UserError(Exception):
    """Anything a user can fix. `str()` names the file or flag, the likely cause and the remedy."""


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong with a scan folder, in words a person can act on.

    `file` is relative to the folder; `frame` is the frame's name, None where the fault concerns all frames;
    `field` is a key of transforms.json, a member of a file or None.
    """

    file: str
    frame: str | None
    field: str | None
    problem: str
    cause: str
    remedy: str

    def __str__(self) -> str:
        """Three lines: where and what, why, what to do."""
        # The frame is named only if the file's name does not already show which one it is.
        frame = None if self.frame is None or self.frame in self.file else f"frame {self.frame}"
        where = ": ".join(part for part in (self.file, frame, self.field) if part)
        return f"{where}: {self.problem}\n    cause:  {self.cause}\n    remedy: {self.remedy}"

    @property
    def kind(self) -> tuple[str | None, ...]:
        """Equal for faults that differ only in their place and their numbers."""
        place = self.field if self.frame is not None else None  # without frames, it is the fields that differ
        file = self.file if self.frame is None else self.file.rpartition("/")[0]
        return (file, place, *(re.sub(r"\d[\d.]*", "#", text) for text in (self.problem, self.cause, self.remedy)))


def first_line(error: Exception) -> str:
    """The first line of what another library says, or the error's kind if it says nothing."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:_LONGEST]


def last_line(error: BaseException) -> str:
    """The last line of what another library says, or the error's kind if it says nothing."""
    return (str(error).strip().splitlines() or [type(error).__name__])[-1].strip()[:_LONGEST]


class ScanError(UserError):
    """A scan folder that must not be used, with everything that is wrong with it."""

    def __init__(self, faults: Sequence[Fault], where: str = "the scan") -> None:
        """`where` names the folder; `faults` holds at least one fault."""
        self.faults: list[Fault] = list(faults)
        count = "1 fault" if len(self.faults) == 1 else f"{len(self.faults)} faults"
        super().__init__("\n".join([f"{count} in {where}", *_lines(self.faults)]))


def _lines(faults: Sequence[Fault]) -> list[str]:
    """The faults in their order; those of a frequent kind stand together at the first of them."""
    kinds: dict[tuple[str | None, ...], list[Fault]] = {}
    for fault in faults:
        kinds.setdefault(fault.kind, []).append(fault)
    return [line for alike in kinds.values() for line in _lines_of_kind(alike)]


def _lines_of_kind(alike: Sequence[Fault]) -> list[str]:
    if len(alike) <= _SHOWN:
        return list(map(str, alike))
    others = list(dict.fromkeys(fault.frame or fault.field or fault.file for fault in alike[1:]))
    named = ", ".join(others[:_NAMED]) + (", .." if len(others) > _NAMED else "")
    what = "frames" if alike[0].frame is not None else "places"
    return [str(alike[0]), f"    and {len(alike) - 1} more {what}: {named}"]
