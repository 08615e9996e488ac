"""Two processes that train together against one: pixels a second, each process on its own core, and the surface.

    python -m benchmarks.several_processes [--steps 500] [--output FILE]

`one` and `two` draw 1024 pixels a step in each process; `both` is one process that draws as many as two do together, so
that its surface can be compared. Time is that of the steps, as the command prints it.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.common.machine import write_rows
from benchmarks.common.whole_runs import run, train_and_score

_PIXELS = 1024
_SECONDS = re.compile(r"^train .*\((?:(\d+) min )?(\d+) s\)$", re.MULTILINE)


@dataclass(frozen=True)
class Kind:
    """How a training is divided."""

    name: str
    processes: int
    pixels: int  # that each process draws a step

    def options(self, steps: int) -> tuple[str, ...]:
        """Flags of ns-train."""
        return (
            *("--machine.device-type", "cpu", "--machine.num-devices", str(self.processes)),
            *("--max-num-iterations", str(steps), "--pipeline.datamanager.train-num-rays-per-batch", str(self.pixels)),
        )


@dataclass(frozen=True)
class Row:
    """One kind of training."""

    name: str
    pixels_per_second: float
    surface_rmse: float  # mm
    camera_mm: float


KINDS = (Kind("one", 1, _PIXELS), Kind("both", 1, 2 * _PIXELS), Kind("two", 2, _PIXELS))


def measure(scan: Path, folder: Path, kinds: Sequence[Kind], steps: int) -> list[Row]:
    """Train and score each kind on as many cores as it has processes."""
    rows = []
    for kind in kinds:
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: kind.processes])
        score = train_and_score(scan, folder, kind.name, kind.options(steps))
        seconds = _training_seconds(scan, folder, kind, steps)
        pixels = kind.processes * kind.pixels * steps / seconds
        row = Row(kind.name, pixels, score.rigid_rmse, score.camera_translation_rmse)
        print(f"{row.name:6} {pixels:8.0f} pixels/s  surface {row.surface_rmse:.4f} mm", flush=True)
        rows.append(row)
        os.sched_setaffinity(0, range(os.cpu_count() or 1))
    return rows


def _training_seconds(scan: Path, folder: Path, kind: Kind, steps: int) -> float:
    """Of the same training once more, without its start."""
    words = (
        "ns-train",
        "sl-neus",
        "--data",
        str(scan),
        "--output-dir",
        str(folder),
        "--timestamp",
        f"{kind.name}-timed",
    )
    program = Path(sys.executable).parent / words[0]
    done = subprocess.run([program, *words[1:], *kind.options(steps)], capture_output=True, text=True, check=True)
    found = _SECONDS.search(done.stdout)
    assert found is not None, done.stdout
    return 60 * int(found[1] or 0) + int(found[2])


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=500, help="steps of each training")
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/several_processes.json"))
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        scan = Path(temporary) / "scan"
        run("sl-synth", "--output", str(scan))
        rows = measure(scan, Path(temporary), KINDS, options.steps)
    write_rows(options.output, rows, steps=options.steps)


if __name__ == "__main__":
    main()
