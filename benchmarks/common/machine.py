"""The machine that a figure was measured on."""

import json
import os
import platform
import subprocess
from collections.abc import Sequence
from dataclasses import asdict
from datetime import date
from pathlib import Path
from typing import Any


def describe() -> dict[str, str | int]:
    """Processor, cores, Python, torch, date and commit."""
    import torch

    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True).stdout.strip()
    return {
        "processor": _processor(),
        "cores": os.cpu_count() or 1,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "date": date.today().isoformat(),
        "commit": commit,
    }


def write_rows(output: Path, rows: Sequence[Any], **settings: Any) -> None:
    """Write the rows of a benchmark (dataclasses) as JSON, with machine and settings; create the folder if needed."""
    output.parent.mkdir(parents=True, exist_ok=True)
    document = {"machine": describe(), **settings, "rows": [asdict(row) for row in rows]}
    output.write_text(json.dumps(document, indent=1) + "\n")


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
