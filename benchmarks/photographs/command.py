"""sl-process as a user runs it."""

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path


def process(captures: Path, output: Path, work: Path, jobs: int, more: Sequence[str]) -> str:
    """Run sl-process with `more` flags; return what it says if it makes no scan, else ""."""
    files = {"images": "images", "pattern": "pattern.json", "intrinsics": "intrinsics.json"}
    flags = [word for flag, name in files.items() for word in (f"--{flag}", str(captures / name))]
    flags += ["--output", str(output), "--work", str(work), "--jobs", str(jobs), *more]
    command = [sys.executable, "-m", "sl_nerfstudio.cli.process", *flags]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return "" if done.returncode == 0 else done.stderr.strip() or f"exit status {done.returncode}"
