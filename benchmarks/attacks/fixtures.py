"""The right input that attacks spoil: a small scan, captures, a pattern and a trained run."""

import shutil
import subprocess
import sys
from pathlib import Path

from benchmarks.attacks.case import Case, Fixture
from sl_nerfstudio.errors import UserError

_CAPTURES = 6
_COMMANDS: dict[Fixture, list[str]] = {
    "scan": ["sl-synth", "--output", "scan", "--frames", "6", "--resolution", "120", "--seed", "3"],
    "captures": ["sl-synth", "--output", "captures", "--frames", "22", "--resolution", "300", "--scene", "head",
                 "--images-only", "--seed", "3"],
    "pattern": ["sl-pattern", "--output", "pattern"],
    "run": ["ns-train", "sl-neus", "--data", "scan", "--output-dir", "run", "--experiment-name", "scan",
            "--timestamp", "first", "--max-num-iterations", "20"],
}  # fmt: skip


def make_fixtures(root: Path) -> None:
    """Make those that are missing in `root`; the run is `run/scan/sl-neus/first`."""
    root.mkdir(parents=True, exist_ok=True)
    for name, command in _COMMANDS.items():
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


def lay_out(case: Case, root: Path, folder: Path) -> None:
    """Copy the fixtures of a case into its own, new folder."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name in case.fixtures:
        shutil.copytree(root / name, folder / name)
