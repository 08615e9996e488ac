"""What the error depends on: decoding quality, number of frames, image size, time.

    python -m benchmarks.sensitivity.sweeps [--sweeps noise missing wrong frames resolution time] [--scene SCENE]

Whole runs with the commands a user types, on scans from sl-synth with its default noise, except for what the sweep
changes. Prints a table and writes benchmarks/results/sweeps.json, from which `python -m benchmarks.plots` draws the
curves.
"""

import argparse
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from benchmarks.common.machine import write_rows
from benchmarks.common.whole_runs import Score, run, train_and_score, with_true_poses

SYNTH = {
    "noise": ("--noise", (0.0, 0.3, 0.6, 1.0, 2.0)),
    "missing": ("--missing", (0.0, 0.15, 0.3, 0.45, 0.6)),
    "wrong": ("--wrong", (0.0, 0.02, 0.05, 0.1, 0.15)),
    "frames": ("--frames", (3, 6, 11, 22, 57)),
    "resolution": ("--resolution", (200, 400, 800, 1200)),
}
TIME = {
    "sl-neus": ("sl-neus", (), (100, 200, 400, 1000)),
    "oracle": ("sl-neus", ("--pipeline.model.refine-poses", "off"), (100, 400, 1000)),
    "unrefined": ("sl-neus", ("--pipeline.model.refine-poses", "off"), (100, 400)),
    "sl-neus-paper": ("sl-neus-paper", (), (100, 300, 1000, 10_000)),
}
SWEEPS = (*SYNTH, "time")


@dataclass(frozen=True)
class Row(Score):
    """One run."""

    sweep: str
    variant: str
    value: float  # of what the sweep changes; number of iterations in the sweep over time


def synth(options: argparse.Namespace, folder: Path, *flags: str) -> Path:
    """A scan made with these flags, unless it exists."""
    scan = folder / "scan"
    if not scan.exists():
        fixed = ("--scene", options.scene, "--seed", str(options.seed))
        run("sl-synth", "--output", str(scan), *fixed, *flags)
    return scan


def over_scans(options: argparse.Namespace, sweep: str) -> Iterator[Row]:
    """One scan and one run for each value."""
    flag, values = SYNTH[sweep]
    for value in values:
        folder = options.folder / f"{sweep}-{value}"
        folder.mkdir(exist_ok=True)
        scan = synth(options, folder, flag, str(value))
        score = train_and_score(scan, folder, "run", ("--max-num-iterations", str(options.iterations)))
        yield Row(**asdict(score), sweep=sweep, variant="sl-neus", value=value)


def over_time(options: argparse.Namespace) -> Iterator[Row]:
    """One scan; runs of growing length, each with its schedules stretched to fit."""
    folder = options.folder / "time"
    folder.mkdir(exist_ok=True)
    scan = synth(options, folder)
    true = with_true_poses(scan, folder / "true")
    for variant, (method, flags, lengths) in TIME.items():
        data = true if variant == "oracle" else scan
        for steps in lengths:
            name = f"{variant}-{steps}"
            score = train_and_score(data, folder, name, ("--max-num-iterations", str(steps), *flags), method)
            yield Row(**asdict(score), sweep="time", variant=variant, value=steps)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sweeps", nargs="+", default=list(SWEEPS), choices=SWEEPS)
    parser.add_argument("--scene", default="cone-and-cylinder")
    parser.add_argument("--seed", type=int, default=4)
    parser.add_argument("--iterations", type=int, default=400, help="of all sweeps except the one over time")
    parser.add_argument("--folder", type=Path, default=Path("outputs/sweeps"), help="must not exist yet")
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/sweeps.json"))
    options = parser.parse_args()
    options.folder.mkdir(parents=True)
    rows: list[Row] = []
    for sweep in options.sweeps:
        for row in over_time(options) if sweep == "time" else over_scans(options, sweep):
            rows.append(row)
            print(f"{sweep:10} {row.variant:13} {row.value:7g} {row.text()}", flush=True)
            write_rows(options.output, rows, scene=options.scene, seed=options.seed, iterations=options.iterations)


if __name__ == "__main__":
    main()
