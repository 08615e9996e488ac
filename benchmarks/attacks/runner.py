"""Run attacks side by side, each in a folder of its own."""

import shutil
import time
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

from benchmarks.attacks import flags, foreign_runs, kills
from benchmarks.attacks.commands import Case, preload

GROUPS = (flags.cases, foreign_runs.cases, kills.cases)


@dataclass(frozen=True)
class Outcome:
    """How one case ended."""

    group: str
    name: str
    fault: str  # "" if the package did right
    seconds: float


def all_cases() -> list[Case]:
    """The cases of all groups, in their order."""
    return [case for cases in GROUPS for case in cases()]


def run_case(index: int, root: Path, keep: bool) -> Outcome:
    """One case, in a folder of its own that is removed afterwards."""
    case, folder = all_cases()[index], root / "cases" / f"{index:04d}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name in case.fixtures:
        shutil.copytree(root / "fixtures" / name, folder / name)
    begin = time.monotonic()
    try:
        fault = case.attack(folder)
    except Exception:
        fault = f"the case itself failed: {traceback.format_exc().strip().splitlines()[-1]}"
    outcome = Outcome(case.group, case.name, fault, round(time.monotonic() - begin, 2))
    if not (keep and fault):
        shutil.rmtree(folder, ignore_errors=True)
    return outcome


def run_cases(chosen: Sequence[int], root: Path, jobs: int, keep: bool) -> Iterator[Outcome]:
    """Outcomes in the order in which they are ready."""
    with ProcessPoolExecutor(jobs, get_context("spawn"), preload) as pool:
        for future in as_completed([pool.submit(run_case, index, root, keep) for index in chosen]):
            yield future.result()
