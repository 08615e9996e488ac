"""Time and memory of every stage against the number of frames.

    python -m benchmarks.large_scans [--frames 22 60 150 400] [--resolution 400] [--steps 60] [--photographs 22]
        [--folder DIR] [--output FILE]

Scans of sl-synth, each stage in a process of its own, with the commands that a user types; so are the parts of a
training run before and during its steps. `--photographs` names the numbers of frames that also go from plain
photographs through `sl-process`, which takes long. Scans and runs stay in the folder; stages that have their results in
the output file are not repeated. `--parts SCAN` only prints the parts of a training on a scan, in this process.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.common.measuring import Part, Rows, kept_rows, markdown, measured, options


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

    def command(self, stage: str, writes: Path | None, *command: object) -> Row:
        """Run a command, and measure it; what it writes is removed before."""
        words = tuple(map(str, command))
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


def parts_of_training(scan: Path, steps: int) -> dict[str, Part]:
    """Reading, adjustment, and steps with all poses, in this process; each with its own peak, of the steps medians."""
    from sl_nerfstudio.dataparser.dataparser import load_scan
    from sl_nerfstudio.methods import sl_neus

    parts: dict[str, Part] = {}
    _, parts["read"] = measured(lambda: load_scan(scan))
    with tempfile.TemporaryDirectory() as folder:
        config = replace(sl_neus.config, output_dir=Path(folder), max_num_iterations=1000)
        config.pipeline.datamanager.data = scan
        config.pipeline.model.warm_start = 0.0  # type: ignore[attr-defined]  # rendering from the first step on
        config.set_timestamp()
        trainer = config.setup(local_rank=0, world_size=1)
        _, parts["set up"] = measured(trainer.setup)
        model, samples = trainer.pipeline.model, trainer.pipeline.datamanager.samples
        _, parts["adjust"] = measured(lambda: model.adjust_poses(samples))
        _, parts["measure noise"] = measured(lambda: model.measure_noise(samples))
        each = []
        for step in range(1, steps + 1):
            model.anneal(step)
            each.append(measured(lambda step=step: trainer.train_iteration(step))[1])
    late = each[len(each) // 3 :]
    seconds, cpu = (float(np.median([getattr(p, name) for p in late])) for name in ("seconds", "cpu_seconds"))
    return {**parts, "step": Part(seconds, cpu, max(p.peak_gb for p in late))}


def training(case: Case) -> list[Row]:
    """Measure the parts of a training in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.large_scans", "--parts", str(case.scan), "--steps", str(case.steps)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stdout + done.stderr)
    found = json.loads(done.stdout.strip().splitlines()[-1])
    return [Row(case.frames, case.resolution, f"training: {name}", **part) for name, part in found.items()]


def stages(case: Case, photographs: bool) -> dict[str, Callable[[], list[Row]]]:
    """Every stage by the name of its first row."""
    folder, scan, mesh, refined = case.folder, case.scan, case.folder / "mesh.ply", case.folder / "refined"
    run, images, processed = folder / "runs/run/sl-neus/a", folder / "images", folder / "processed"
    synth = ("--scene", "frog", "--frames", case.frames, "--resolution", case.resolution, "--seed", 1)
    steps, report = "ns-train, 300 steps", folder / "report.html"
    into = ("--output-dir", folder / "runs", "--experiment-name", "run", "--timestamp", "a")

    def from_photographs() -> list[Row]:
        made = case.command("sl-synth --images-only", images, "sl-synth", "--output", images, "--images-only", *synth)
        shutil.rmtree(folder / "processed.work", ignore_errors=True)
        files = ("--images", images / "images", "--pattern", images / "pattern.json", "--intrinsics",
                 images / "intrinsics.json")  # fmt: skip
        return [made, case.command("sl-process", processed, "sl-process", *files, "--output", processed)]

    found = {
        "sl-synth": lambda: [case.command("sl-synth", scan, "sl-synth", "--output", scan, *synth)],
        "sl-check": lambda: [case.command("sl-check", None, "sl-check", scan)],
        "training: read": lambda: training(case),
        steps: lambda: [case.command(steps, run, "ns-train", "sl-neus", "--data", scan, *into,
                                     "--max-num-iterations", 300)],
        "sl-export": lambda: [case.command("sl-export", mesh, "sl-export", "--load-config", run / "config.yml",
                                           "--output", mesh, "--poses", refined)],
        "sl-eval": lambda: [case.command("sl-eval", report, "sl-eval", "--mesh", mesh, "--data", scan, "--poses",
                                         refined, "--report", report)],
    }  # fmt: skip
    return {**found, "sl-process": from_photographs} if photographs else found


def table(rows: list[Row]) -> str:
    """Markdown: a line for each stage, a column for each number of frames; processor time where it was measured."""
    counts, found = sorted({row.frames for row in rows}), {(row.stage, row.frames): row for row in rows}

    def cell(row: Row | None) -> str:
        if row is None:
            return ""
        taken = row.seconds if row.cpu_seconds is None else row.cpu_seconds
        return (f"{1000 * taken:.0f} ms" if taken < 1 else f"{taken:.0f} s") + f", {row.peak_gb:.1f} GB"

    lines = [(stage, *(cell(found.get((stage, n))) for n in counts)) for stage in dict.fromkeys(r.stage for r in rows)]
    return markdown(("stage", *(f"{n} frames" for n in counts)), lines)


def main() -> None:
    """Run the benchmark."""
    given = options(
        __doc__, frames=[22, 60, 150, 400], resolution=400, steps=60, photographs=[22], parts=Path,
        folder=Path("outputs/large_scans"), output=Path("benchmarks/results/large_scans.json"),
    )  # fmt: skip
    if given.parts is not None:
        print(json.dumps({name: asdict(part) for name, part in parts_of_training(given.parts, given.steps).items()}))
        return
    rows = Rows(given.output, kept_rows(given.output, Row))
    for frames in given.frames:
        folder = given.folder / f"{frames}x{given.resolution}"
        folder.mkdir(parents=True, exist_ok=True)
        case = Case(frames, given.resolution, given.steps, folder.absolute())
        for name, stage in stages(case, frames in given.photographs).items():
            if (name, frames, given.resolution) not in {(r.stage, r.frames, r.resolution) for r in rows}:
                rows.add(*stage())
    print(table([row for row in rows if row.resolution == given.resolution]))


if __name__ == "__main__":
    main()
