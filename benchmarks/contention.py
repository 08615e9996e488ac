"""Time of the commands beside busy processes, against their fair share of the machine.

    python -m benchmarks.contention [--busy 8] [--steps 200] [--folder DIR] [--output FILE]

Each command runs alone, and beside processes that each keep one core busy. With c cores and b busy processes, a command
that uses all cores gets c of c + b threads' time: its fair share is (c + b) / c times the time alone. `ratio` is the
measured time over that.
"""

import argparse
import multiprocessing
import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from benchmarks.common.machine import write_rows
from benchmarks.common.whole_runs import run
from sl_nerfstudio.parallel import cores


@dataclass(frozen=True)
class Row:
    """One command."""

    command: str
    alone_seconds: float
    beside_seconds: float
    ratio: float  # of the time beside busy processes to the fair share


@dataclass(frozen=True)
class Step:
    """A command, and what it writes: removed before it is run again."""

    words: tuple[str, ...]
    writes: tuple[Path, ...]

    def timed(self) -> float:
        """Seconds of one run."""
        for path in self.writes:
            shutil.rmtree(path, ignore_errors=True)
            path.unlink(missing_ok=True)
        begin = time.monotonic()
        run(*self.words)
        return time.monotonic() - begin


def steps(folder: Path, iterations: int) -> list[Step]:
    """From a synthetic scan to its report, and from photographs to a scan."""
    scan, images, processed = folder / "scan", folder / "images", folder / "processed"
    trained = folder / "run" / "scan" / "sl-neus" / "a"
    mesh, poses, report = folder / "mesh.ply", folder / "refined", folder / "report.html"
    return [
        Step(("sl-synth", "--output", str(scan)), (scan,)),
        Step(("sl-check", str(scan)), ()),
        Step(
            (
                *("ns-train", "sl-neus", "--data", str(scan), "--output-dir", str(folder / "run")),
                *("--experiment-name", "scan", "--timestamp", "a", "--max-num-iterations", str(iterations)),
            ),
            (folder / "run",),
        ),
        Step(
            ("sl-export", "--load-config", str(trained / "config.yml"), "--output", str(mesh), "--poses", str(poses)),
            (mesh, poses),
        ),
        Step(("sl-eval", "--mesh", str(mesh), "--data", str(scan), "--report", str(report)), (report,)),
        Step(("sl-synth", "--output", str(images), "--images-only", "--frames", "8", "--resolution", "300"), (images,)),
        Step(
            (
                *("sl-process", "--images", str(images / "images"), "--pattern", str(images / "pattern.json")),
                *("--intrinsics", str(images / "intrinsics.json"), "--output", str(processed)),
            ),
            (processed,),
        ),
    ]


def _spin() -> None:
    while True:
        pass


@contextmanager
def busy(count: int) -> Iterator[None]:
    """Processes that each keep one core busy until the block ends."""
    processes = [multiprocessing.Process(target=_spin, daemon=True) for _ in range(count)]
    for process in processes:
        process.start()
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.join()


def measure(todo: Sequence[Step], count: int) -> Iterator[Row]:
    """Each command twice: beside busy processes and alone, the first time not counted (compilation)."""
    available = cores()
    for step in todo:
        step.timed()
        alone = step.timed()
        with busy(count):
            beside = step.timed()
        yield Row(step.words[0], alone, beside, beside / (alone * (available + count) / available))


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--busy", type=int, default=8, help="processes that each keep one core busy")
    parser.add_argument("--steps", type=int, default=200, help="steps of the training")
    parser.add_argument("--folder", type=Path, help="must not exist yet; by default a temporary one")
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/contention.json"))
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary) / "contention"
        folder.mkdir(parents=True)
        rows: list[Row] = []
        for row in measure(steps(folder, options.steps), options.busy):
            print(
                f"{row.command:12} {row.alone_seconds:7.1f} s {row.beside_seconds:7.1f} s {row.ratio:5.2f}", flush=True
            )
            rows.append(row)
            write_rows(options.output, rows, busy=options.busy, steps=options.steps)


if __name__ == "__main__":
    main()
