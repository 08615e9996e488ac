"""All groups of attacks, in the order of the table."""

from collections.abc import Callable

from benchmarks.attacks import (
    bad_input,
    bad_meshes,
    command_lines,
    foreign_runs,
    interrupted_trainings,
    kill_process,
    kills,
    output_folders,
    process_input,
    training_folders,
    wrong_scans,
)
from benchmarks.attacks.case import Case

GROUPS: tuple[Callable[[], list[Case]], ...] = (
    command_lines.cases,
    bad_input.cases,
    bad_meshes.cases,
    wrong_scans.cases,
    foreign_runs.cases,
    interrupted_trainings.cases,
    training_folders.cases,
    output_folders.cases,
    kills.cases,
    kill_process.cases,
    process_input.cases,
)
"""Every function gives the cases of a module."""
