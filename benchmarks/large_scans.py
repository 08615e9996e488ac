"""Time and memory of every stage against the number of frames.

    python -m benchmarks.large_scans [--frames 22 60 150 400] [--resolution 400] [--steps 60] [--photographs 22]
        [--folder DIR] [--output FILE]

Scans of sl-synth, each stage in a process of its own, with the commands that a user types; the parts of a training run
before and during its steps are measured by `benchmarks.resources`. `--photographs` names the numbers of frames that
also go from plain photographs through `sl-process`, which takes long. Scans and runs stay in the folder; stages that
have their results in the output file are not repeated.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from benchmarks.common.machine import write_rows
from benchmarks.resources import measure


@dataclass(frozen=True)
class Row:
    """One stage of one scan."""

    frames: int
    resolution: int
    stage: str
    seconds: float
    cpu_seconds: float | None  # of all threads and processes; None in rows of an earlier version
    peak_gb: float  # resident memory of the largest process, libraries included


@dataclass(frozen=True)
class Case:
    """A scan, and the folder of what is made of it."""

    frames: int
    resolution: int
    steps: int
    folder: Path

    @property
    def scan(self) -> Path:
        """The scan folder."""
        return self.folder / "scan"

    @property
    def run(self) -> Path:
        """The training run."""
        return self.folder / "runs" / "run" / "sl-neus" / "a"

    @property
    def mesh(self) -> Path:
        """The exported surface."""
        return self.folder / "mesh.ply"

    @property
    def synth(self) -> tuple[str, ...]:
        """Flags of sl-synth."""
        size = str(self.resolution)
        return "--scene", "frog", "--frames", str(self.frames), "--resolution", size, "--seed", "1"

    def command(self, stage: str, writes: Path | None, *words: str) -> Row:
        """Run a command, and measure it; what it writes is removed before."""
        if writes is not None and writes.exists():
            shutil.rmtree(writes) if writes.is_dir() else writes.unlink()
        log = self.folder / f"{stage.replace(' ', '-')}.log"
        begin = time.monotonic()
        with log.open("w") as out:
            program = str(Path(sys.executable).parent / words[0])
            process = subprocess.Popen([program, *words[1:]], stdout=out, stderr=subprocess.STDOUT)
            _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise SystemExit(f"{' '.join(words)}\n{log.read_text()[-3000:]}")
        seconds, cpu = time.monotonic() - begin, used.ru_utime + used.ru_stime
        return Row(self.frames, self.resolution, stage, seconds, cpu, used.ru_maxrss / 1024**2)


def made(case: Case) -> list[Row]:
    """The scan itself."""
    return [case.command("sl-synth", case.scan, "sl-synth", "--output", str(case.scan), *case.synth)]


def checked(case: Case) -> list[Row]:
    """Every file read and compared."""
    return [case.command("sl-check", None, "sl-check", str(case.scan))]


def parts_of_training(case: Case) -> list[Row]:
    """Reading, adjustment, and one step with all poses, in one process; each with its own peak of memory."""
    found = measure(case.scan, case.steps, with_check=False)
    return [
        Row(case.frames, case.resolution, f"training: {name}", part.seconds, part.cpu_seconds, part.peak_gb)
        for name, part in found.items()
    ]


def trained(case: Case) -> list[Row]:
    """The whole command."""
    words = ("--data", str(case.scan), "--output-dir", str(case.folder / "runs"), "--experiment-name", "run")
    fixed = ("--timestamp", "a", "--max-num-iterations", "300")
    return [case.command("ns-train, 300 steps", case.run, "ns-train", "sl-neus", *words, *fixed)]


def exported(case: Case) -> list[Row]:
    """The trimmed mesh with the uncertainty of its vertices, and the refined poses with their covariance."""
    return [case.command("sl-export", case.mesh, "sl-export", "--load-config", str(case.run / "config.yml"),
                         "--output", str(case.mesh), "--poses", str(case.folder / "refined"))]  # fmt: skip


def evaluated(case: Case) -> list[Row]:
    """Mesh and poses against the truth, with the report."""
    files = ("--mesh", str(case.mesh), "--data", str(case.scan), "--poses", str(case.folder / "refined"))
    report = case.folder / "report.html"
    return [case.command("sl-eval", report, "sl-eval", *files, "--report", str(report))]


def processed(case: Case) -> list[Row]:
    """From plain photographs to a scan without any pose."""
    images, output = case.folder / "images", case.folder / "processed"
    rows = [case.command("sl-synth --images-only", images, "sl-synth", "--output", str(images), "--images-only",
                         *case.synth)]  # fmt: skip
    shutil.rmtree(case.folder / "processed.work", ignore_errors=True)
    flags = ("--images", "images", "--pattern", "pattern.json", "--intrinsics", "intrinsics.json")
    words = [str(images / word) if k % 2 else word for k, word in enumerate(flags)]
    return [*rows, case.command("sl-process", output, "sl-process", *words, "--output", str(output))]


def table(rows: list[Row]) -> str:
    """Markdown: a line for each stage, a column for each number of frames; processor time where it was measured."""
    counts = sorted({row.frames for row in rows})
    found = {(row.stage, row.frames): row for row in rows}
    lines = ["| stage | " + " | ".join(f"{n} frames" for n in counts) + " |", "|---" * (len(counts) + 1) + "|"]
    for stage in dict.fromkeys(row.stage for row in rows):
        cells = [_cell(found.get((stage, n))) for n in counts]
        lines.append(f"| {stage} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _cell(row: Row | None) -> str:
    if row is None:
        return ""
    taken = row.seconds if row.cpu_seconds is None else row.cpu_seconds
    seconds = f"{1000 * taken:.0f} ms" if taken < 1 else f"{taken:.0f} s"
    return f"{seconds}, {row.peak_gb:.1f} GB"


STAGES = (made, checked, parts_of_training, trained, exported, evaluated)
FIRST = {made: "sl-synth", checked: "sl-check", parts_of_training: "training: read", trained: "ns-train, 300 steps",
         exported: "sl-export", evaluated: "sl-eval", processed: "sl-process"}  # fmt: skip


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", nargs="+", type=int, default=[22, 60, 150, 400])
    parser.add_argument("--resolution", type=int, default=400)
    parser.add_argument("--steps", type=int, default=60, help="timed steps")
    parser.add_argument("--photographs", nargs="*", type=int, default=[22], help="numbers of frames for sl-process")
    parser.add_argument("--folder", type=Path, default=Path("outputs/large_scans"))
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/large_scans.json"))
    options = parser.parse_args()
    rows = [Row(**row) for row in json.loads(options.output.read_text())["rows"]] if options.output.exists() else []
    for frames in options.frames:
        folder = options.folder / f"{frames}x{options.resolution}"
        folder.mkdir(parents=True, exist_ok=True)
        case = Case(frames, options.resolution, options.steps, folder.absolute())
        for stage in (*STAGES, *([processed] if frames in options.photographs else [])):
            if (FIRST[stage], frames, options.resolution) in {(r.stage, r.frames, r.resolution) for r in rows}:
                continue
            rows += stage(case)
            write_rows(options.output, rows)
            print(asdict(rows[-1]), flush=True)
    print(table([row for row in rows if row.resolution == options.resolution]))


if __name__ == "__main__":
    main()
