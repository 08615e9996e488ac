"""Attack the commands with bad input, kills and collisions, and count what they did right.

    python -m benchmarks.attacks [--groups TEXT ...] [--jobs 4] [--output FILE]

A case is right if the command refused with a message that names the cause, or succeeded with the right result. It is
wrong if it crashed, hung, printed a traceback, or ended with status 0 and a wrong result.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from benchmarks.attacks.fixtures import make_fixtures
from benchmarks.attacks.runner import Outcome, all_cases, run_cases
from benchmarks.common.machine import write_rows
from sl_nerfstudio.cli.run import run


@dataclass(frozen=True)
class Config:
    """Which cases are run, and where."""

    groups: tuple[str, ...] = ()
    """parts of the names of groups or cases; default: all"""
    folder: Path = Path("outputs/attacks")
    """folder of the fixtures and of the cases"""
    jobs: int = 4
    """number of cases that run at the same time"""
    keep: bool = False
    """keep the folders of the cases that went wrong"""
    output: Path | None = None
    """where to write all outcomes as JSON, with machine, date and commit"""


def table(outcomes: Sequence[Outcome]) -> str:
    """A line a group."""
    lines = ["| group | cases | right | wrong |", "|---|---|---|---|"]
    for group in [*dict.fromkeys(outcome.group for outcome in outcomes), None]:
        some = [outcome for outcome in outcomes if group in (None, outcome.group)]
        wrong = sum(bool(outcome.fault) for outcome in some)
        lines.append(f"| {group or 'all'} | {len(some)} | {len(some) - wrong} | {wrong} |")
    return "\n".join(lines)


def main() -> None:
    """Print what went wrong and the table."""
    config = tyro.cli(Config, description=__doc__)
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    make_fixtures(config.folder.absolute() / "fixtures")
    cases = all_cases()
    chosen = [
        index
        for index, case in enumerate(cases)
        if not config.groups or any(part in f"{case.group}: {case.name}" for part in config.groups)
    ]
    outcomes = {}
    for outcome in run_cases(chosen, config.folder.absolute(), config.jobs, config.keep):
        outcomes[outcome.group, outcome.name] = outcome
        if outcome.fault:
            print(f"{outcome.group}: {outcome.name}: {outcome.fault}", flush=True)
    ordered = [outcomes[cases[index].group, cases[index].name] for index in chosen]
    print(table(ordered))
    if config.output is not None:
        write_rows(config.output, ordered)


if __name__ == "__main__":
    run(main)
