"""Time and memory of every stage from photographs, or from a scan, to the report on the mesh.

    python -m benchmarks.chain [--start photographs|scans] [--frames 24 60 150 400] [--resolution 600] [--jobs 1]
        [--steps 300] [--until process|eval] [--before FOLDER] [--folder DIR] [--output FILE]

Each stage is a command in a process of its own, as a user types it; of `sl-process` also its phases, and of training on
a scan its parts, which other processes measure. `--before` is a checkout of an earlier version, whose `sl-process` is
given the same photographs just before ours. Photographs, scans and runs stay in the folder; stages that have their
results in the output file are not repeated. `--parts SCAN` prints the parts of a training, `--phases IMAGES SCAN` the
phases of `sl-process`, each in this process.
"""

import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.common.measuring import Part, Rows, kept_rows, markdown, measured, options, peak_gb


@dataclass(frozen=True)
class Row:
    """One stage of one scan."""

    frames: int
    resolution: int
    stage: str
    seconds: float
    cpu_seconds: float | None  # of all threads and processes; None in rows of an earlier version
    peak_gb: float  # resident memory of the largest process, libraries included
    jobs: int = 1  # processes that decode


@dataclass(frozen=True)
class Case:
    """A scan, and the folder of what is made of it."""

    frames: int
    resolution: int
    steps: int
    jobs: int
    folder: Path

    def command(self, stage: str, writes: Path | None, *command: object, version: Path | None = None) -> Row:
        """Run a command, of an earlier version if its checkout is given; what it writes is removed before."""
        words = tuple(map(str, command))
        if writes is not None and writes.exists():
            shutil.rmtree(writes) if writes.is_dir() else writes.unlink()
        log = self.folder / f"{stage.replace(' ', '-')}.log"
        begin = time.monotonic()
        with log.open("w") as out:
            program = str(Path(sys.executable).parent / words[0])
            paths = os.environ if version is None else {**os.environ, "PYTHONPATH": str(version.absolute())}
            process = subprocess.Popen([program, *words[1:]], stdout=out, stderr=subprocess.STDOUT, env=paths)
            _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise SystemExit(f"{' '.join(words)}\n{log.read_text()[-3000:]}")
        seconds, cpu = time.monotonic() - begin, used.ru_utime + used.ru_stime
        return self.row(stage, Part(seconds, cpu, used.ru_maxrss / 1024**2))

    def row(self, stage: str, part: Part) -> Row:
        """What a stage took."""
        return Row(self.frames, self.resolution, stage, part.seconds, part.cpu_seconds, part.peak_gb, self.jobs)

    def parts(self, stage: str, *words: object) -> list[Row]:
        """Parts of a stage that this module measures in a process of its own."""
        command = [sys.executable, "-m", "benchmarks.chain", *map(str, words)]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(done.stdout + done.stderr)
        found = json.loads(done.stdout.strip().splitlines()[-1])
        return [self.row(f"{stage}: {name}", Part(**part)) for name, part in found.items()]


SCANS = "scan", "scan-before", "scan-phases"  # by sl-process, by an earlier version of it, and for its phases


def forget(folder: Path) -> None:
    """Remove all scans of a folder, and the decoded frames that were kept for them: any of these would be taken."""
    for name in SCANS:
        for kept in (folder / name, folder / f"{name}.work"):
            shutil.rmtree(kept, ignore_errors=True)


def phases_of_process(images: Path, scan: Path, jobs: int) -> dict[str, Part]:
    """What each phase of sl-process takes in this process and its helpers."""
    from sl_nerfstudio.cli.process import process_photographs
    from sl_nerfstudio.processing import process
    from sl_nerfstudio.processing.config import ProcessConfig

    found: dict[str, Part] = {}
    shown = process.phase

    def used() -> float:
        both = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
        return sum(each.ru_utime + each.ru_stime for each in both)

    @contextmanager
    def timed(name: str) -> Iterator[object]:
        wall, cpu = time.monotonic(), used()
        with shown(name) as phase:
            yield phase
        found[name] = Part(time.monotonic() - wall, used() - cpu, peak_gb())

    process.phase = timed  # type: ignore[assignment]
    forget(scan.parent)
    config = ProcessConfig(
        images=images / "images", pattern=images / "pattern.json", intrinsics=images / "intrinsics.json", output=scan,
        jobs=jobs,
    )  # fmt: skip
    process_photographs(config)
    return found


_STEPS = 60  # of a training, whose median is taken


def parts_of_training(scan: Path) -> dict[str, Part]:
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
        for step in range(1, _STEPS + 1):
            model.anneal(step)
            each.append(measured(lambda step=step: trainer.train_iteration(step))[1])
    late = each[len(each) // 3 :]
    seconds, cpu = (float(np.median([getattr(p, name) for p in late])) for name in ("seconds", "cpu_seconds"))
    return {**parts, "step": Part(seconds, cpu, max(p.peak_gb for p in late))}


def stages(case: Case, photographs: bool, until: str, before: Path | None) -> dict[str, Callable[[], list[Row]]]:
    """Every stage by the name of its first row."""
    folder, mesh, refined, report = case.folder, case.folder / "mesh.ply", case.folder / "refined", "report.html"
    run, images, scan = folder / "runs/run/sl-neus/a", folder / "images", folder / "scan"
    synth = ("--scene", "frog", "--frames", case.frames, "--resolution", case.resolution, "--seed", 1)
    into = ("--output-dir", folder / "runs", "--experiment-name", "run", "--timestamp", "a")

    def process(stage: str, version: Path | None) -> list[Row]:
        output = scan if version is None else folder / "scan-before"
        forget(folder)
        words = ("sl-process", "--images", images / "images", "--pattern", images / "pattern.json", "--intrinsics",
                 images / "intrinsics.json", "--output", output, "--jobs", case.jobs)  # fmt: skip
        return [case.command(stage, None, *words, version=version)]

    found: dict[str, Callable[[], list[Row]]] = {}
    if photographs:
        make = ("sl-synth", "--output", images, "--images-only", "--background", "table", *synth)
        found["sl-synth --images-only"] = lambda: [case.command("sl-synth --images-only", images, *make)]
        if before is not None:
            found["sl-process, before"] = lambda: process("sl-process, before", before)
        found["sl-process: read"] = lambda: case.parts(
            "sl-process", "--phases", images, folder / "scan-phases", "--jobs", case.jobs
        )
        found["sl-process"] = lambda: process("sl-process", None)
    else:
        found["sl-synth"] = lambda: [case.command("sl-synth", scan, "sl-synth", "--output", scan, *synth)]
        found["sl-check"] = lambda: [case.command("sl-check", None, "sl-check", scan)]
        found["training: read"] = lambda: case.parts("training", "--parts", scan)
    if until == "process":
        return found
    steps = f"ns-train, {case.steps} steps"
    return {
        **found,
        steps: lambda: [case.command(steps, run, "ns-train", "sl-neus", "--data", scan, *into,
                                     "--max-num-iterations", case.steps)],
        "sl-export": lambda: [case.command("sl-export", mesh, "sl-export", "--load-config", run / "config.yml",
                                           "--output", mesh, "--poses", refined)],
        "sl-eval": lambda: [case.command("sl-eval", folder / report, "sl-eval", "--mesh", mesh, "--data", scan,
                                         "--poses", refined, "--report", folder / report)],
    }  # fmt: skip


def table(rows: list[Row]) -> str:
    """Markdown: a line for each stage, a column for each number of frames and size; processor seconds and clock."""
    cases = sorted({(row.frames, row.resolution, row.jobs) for row in rows})
    found = {(row.stage, row.frames, row.resolution, row.jobs): row for row in rows}

    def cell(row: Row | None) -> str:
        if row is None:
            return ""
        taken = row.seconds if row.cpu_seconds is None else row.cpu_seconds
        if taken < 1:
            return f"{1000 * taken:.0f} ms, {row.peak_gb:.1f} GB"
        return f"{taken:.0f} s ({row.seconds:.0f}), {row.peak_gb:.1f} GB"

    heads = [f"{n} of {size} x {size}" + f", {jobs} jobs" * (jobs > 1) for n, size, jobs in cases]
    stages = dict.fromkeys(row.stage for row in rows)
    return markdown(
        ("stage", *heads), [(stage, *(cell(found.get((stage, *case))) for case in cases)) for stage in stages]
    )


def main() -> None:
    """Run the benchmark."""
    given = options(
        __doc__, start="photographs", frames=[24, 60, 150, 400], resolution=600, jobs=1, steps=300, until="eval",
        before=Path, parts=Path, phases=[Path()], folder=Path("outputs/chain"),
        output=Path("benchmarks/results/chain.json"),
    )  # fmt: skip
    parts: dict[str, Part] = {}
    if given.parts is not None:
        parts = parts_of_training(given.parts)
    elif len(given.phases) == 2:
        parts = phases_of_process(given.phases[0], given.phases[1], given.jobs)
    if parts:
        print(json.dumps({name: asdict(part) for name, part in parts.items()}))
        return
    rows = Rows(given.output, kept_rows(given.output, Row))
    for frames in given.frames:
        folder = given.folder / f"{given.start}-{frames}x{given.resolution}"
        folder.mkdir(parents=True, exist_ok=True)
        case = Case(frames, given.resolution, given.steps, given.jobs, folder.absolute())
        for name, stage in stages(case, given.start == "photographs", given.until, given.before).items():
            if not rows.have(stage=name, frames=frames, resolution=given.resolution, jobs=given.jobs):
                rows.add(*stage())
    print(table(rows))


if __name__ == "__main__":
    main()
