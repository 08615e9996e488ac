"""Two processes that train together against one: pixels a second, each process on its own core, and the surface.

    python -m benchmarks.several_processes [--steps 500] [--output FILE]

`one` and `two` draw 1024 pixels a step in each process; `both` is one process that draws as many as two do together, so
that its surface can be compared. Time is that of the steps, as the command prints it.
"""

import os
import re
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from benchmarks.common.measuring import Rows, options
from benchmarks.common.runs import run, train_and_score

_PIXELS = 1024
_SECONDS = re.compile(r"^train .*\((?:(\d+) min )?(\d+) s\)$", re.MULTILINE)


@dataclass(frozen=True)
class Row:
    """One kind of training."""

    name: str
    pixels_per_second: float
    surface_rmse: float  # mm
    camera_mm: float


KINDS = (("one", 1, _PIXELS), ("both", 1, 2 * _PIXELS), ("two", 2, _PIXELS))  # processes; pixels of each in a step


def measure(scan: Path, folder: Path, steps: int, rows: Rows[Row]) -> None:
    """Train and score each kind on as many cores as it has processes."""
    for name, processes, pixels in KINDS:
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:processes])
        flags = (
            *("--machine.device-type", "cpu", "--machine.num-devices", str(processes)),
            *("--max-num-iterations", str(steps), "--pipeline.datamanager.train-num-rays-per-batch", str(pixels)),
        )
        score = train_and_score(scan, folder, name, flags)
        program, again = Path(sys.executable).parent / "ns-train", f"{name}-timed"  # once more, without its start
        words = (program, "sl-neus", "--data", str(scan), "--output-dir", str(folder), "--timestamp", again)
        done = subprocess.run([*words, *flags], capture_output=True, text=True, check=True)
        found = _SECONDS.search(done.stdout)
        assert found is not None, done.stdout
        seconds = 60 * int(found[1] or 0) + int(found[2])
        rate = processes * pixels * steps / seconds
        rows.add(Row(name, rate, score.rigid_rmse, score.camera_translation_rmse))
        os.sched_setaffinity(0, range(os.cpu_count() or 1))


def main() -> None:
    """Run the benchmark."""
    given = options(__doc__, steps=500, output=Path("benchmarks/results/several_processes.json"))
    with tempfile.TemporaryDirectory() as temporary:
        scan = Path(temporary) / "scan"
        run("sl-synth", "--output", scan)
        measure(scan, Path(temporary), given.steps, Rows(given.output, steps=given.steps))


if __name__ == "__main__":
    main()
