"""All groups of attacks, in the order of the table."""

from collections.abc import Callable

from benchmarks.attacks import command_lines
from benchmarks.attacks.case import Case

GROUPS: tuple[Callable[[], list[Case]], ...] = (command_lines.cases,)
