"""All groups of attacks, in the order of the table."""

from collections.abc import Callable

from benchmarks.attacks import command_lines, foreign_runs, training_runs
from benchmarks.attacks.case import Case

GROUPS: tuple[Callable[[], list[Case]], ...] = (command_lines.cases, foreign_runs.cases, training_runs.cases)
