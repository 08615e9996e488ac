"""Errors that a user can fix: their text is the whole message, and command lines print it without a traceback."""

from collections.abc import Sequence
from dataclasses import dataclass


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


class ScanError(UserError):
    """A scan folder that must not be used, with everything that is wrong with it."""

    def __init__(self, faults: Sequence[Fault], where: str = "the scan") -> None:
        """`where` names the folder; `faults` holds at least one fault."""
        self.faults: list[Fault] = list(faults)
        count = "1 fault" if len(self.faults) == 1 else f"{len(self.faults)} faults"
        super().__init__("\n".join([f"{count} in {where}", *map(str, self.faults)]))
