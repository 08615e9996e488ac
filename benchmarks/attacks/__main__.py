"""Attack the commands with bad input, kills and collisions, and count what they did right.

    python -m benchmarks.attacks [--groups TEXT ...] [--jobs 4] [--keep] [--output FILE]

`--groups` takes parts of the names of groups or cases; `--keep` keeps the folders of the cases that went wrong. A case
is right if the command refused with a message that names the cause, or succeeded with the right result. It is wrong if
it crashed, hung, printed a traceback, or ended with status 0 and a wrong result. What tests/ states of single runs
(wrong scans, intrinsics and meshes, folders of trainings, interrupted trainings, the viewer) is not repeated.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.attacks.runner import Outcome, all_cases, run_cases
from benchmarks.common.measuring import markdown, options, write_rows
from sl_nerfstudio.cli.run import run
from sl_nerfstudio.errors import UserError

_CAPTURES = 6
_FIXTURES = {
    "scan": ("sl-synth", "--output", "scan", "--frames", "6", "--resolution", "120", "--seed", "3"),
    "captures": ("sl-synth", "--output", "captures", "--frames", "22", "--resolution", "300", "--scene", "head",
                 "--images-only", "--seed", "3"),
    "pattern": ("sl-pattern", "--output", "pattern"),
    "run": ("ns-train", "sl-neus", "--data", "scan", "--output-dir", "run", "--experiment-name", "scan",
            "--timestamp", "first", "--max-num-iterations", "20"),
}  # fmt: skip


def make_fixtures(root: Path) -> None:
    """Make the right input that attacks spoil, unless it is in `root`; the run is `run/scan/sl-neus/first`."""
    root.mkdir(parents=True, exist_ok=True)
    for name, command in _FIXTURES.items():
        if (root / f"{name}.complete").exists():
            continue
        shutil.rmtree(root / name, ignore_errors=True)
        program = Path(sys.executable).with_name(command[0])
        done = subprocess.run([str(program), *command[1:]], cwd=root, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise UserError(f"{' '.join(command)}: exit status {done.returncode}\n{done.stderr[-2000:]}")
        if name == "captures":  # neighbours of a longer walk around the object: six all around share too little
            for image in sorted((root / name / "images").iterdir())[_CAPTURES:]:
                image.unlink()
        (root / f"{name}.complete").touch()


def table(outcomes: Sequence[Outcome]) -> str:
    """A line a group."""
    lines = []
    for group in [*dict.fromkeys(outcome.group for outcome in outcomes), None]:
        some = [outcome for outcome in outcomes if group in (None, outcome.group)]
        wrong = sum(bool(outcome.fault) for outcome in some)
        lines.append((group or "all", str(len(some)), str(len(some) - wrong), str(wrong)))
    return markdown(("group", "cases", "right", "wrong"), lines)


def main() -> None:
    """Print what went wrong and the table."""
    given = options(__doc__, groups=[""], folder=Path("outputs/attacks"), jobs=4, keep=False, output=Path)
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    os.environ["SL_CACHE"] = os.devnull  # no run takes what another has kept of the same captures
    root = given.folder.absolute()
    make_fixtures(root / "fixtures")
    cases = all_cases()
    chosen = [k for k, case in enumerate(cases) if any(part in f"{case.group}: {case.name}" for part in given.groups)]
    outcomes = {}
    for outcome in run_cases(chosen, root, given.jobs, given.keep):
        outcomes[outcome.group, outcome.name] = outcome
        if outcome.fault:
            print(f"{outcome.group}: {outcome.name}: {outcome.fault}", flush=True)
    ordered = [outcomes[cases[index].group, cases[index].name] for index in chosen]
    print(table(ordered))
    write_rows(given.output, ordered)


if __name__ == "__main__":
    run(main)
