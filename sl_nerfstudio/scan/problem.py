"""What is wrong with a value, and the collection of everything that is wrong with a folder."""

from dataclasses import dataclass, field

from sl_nerfstudio.errors import Fault
from sl_nerfstudio.scan.file_error import FileError


@dataclass(frozen=True)
class Problem:
    """What is wrong, the likely cause and the remedy; the caller knows the place."""

    problem: str
    cause: str
    remedy: str


@dataclass
class Faults:
    """Collects the faults of one folder."""

    found: list[Fault] = field(default_factory=list)
    _known: set[Fault] = field(default_factory=set)  # the same; a scan may have very many

    def add(self, problem: Problem | FileError, file: str, frame: str | None = None, key: str | None = None) -> None:
        """Add a problem, once. `file` is relative to the folder; `key` is a field in it."""
        self._add(Fault(file, frame, key, problem.problem, problem.cause, problem.remedy))

    def take(self, others: "Faults") -> None:
        """Add those of another collection, once."""
        for fault in others.found:
            self._add(fault)

    def _add(self, fault: Fault) -> None:
        if fault not in self._known:
            self._known.add(fault)
            self.found.append(fault)
