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

from benchmarks.common.measuring import Rows, options
from benchmarks.common.runs import Score, run, train_and_score, with_true_poses

SYNTH = {
    "noise": ("--noise", (0.0, 0.3, 0.6, 1.0, 2.0)), "missing": ("--missing", (0.0, 0.15, 0.3, 0.45, 0.6)),
    "wrong": ("--wrong", (0.0, 0.02, 0.05, 0.1, 0.15)), "frames": ("--frames", (3, 6, 11, 22, 57)),
    "resolution": ("--resolution", (200, 400, 800, 1200)),
}  # fmt: skip
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


def over_scans(given: argparse.Namespace, sweep: str) -> Iterator[Row]:
    """One scan and one run for each value."""
    flag, values = SYNTH[sweep]
    for value in values:
        folder = given.folder / f"{sweep}-{value}"
        folder.mkdir()
        run("sl-synth", "--output", folder / "scan", "--scene", given.scene, "--seed", given.seed, flag, value)
        score = train_and_score(folder / "scan", folder, "run", ("--max-num-iterations", str(given.iterations)))
        yield Row(**asdict(score), sweep=sweep, variant="sl-neus", value=value)


def over_time(given: argparse.Namespace) -> Iterator[Row]:
    """One scan; runs of growing length, each with its schedules stretched to fit."""
    folder = given.folder / "time"
    folder.mkdir()
    scan = folder / "scan"
    run("sl-synth", "--output", scan, "--scene", given.scene, "--seed", given.seed)
    true = with_true_poses(scan, folder / "true")
    for variant, (method, flags, lengths) in TIME.items():
        data = true if variant == "oracle" else scan
        for steps in lengths:
            name = f"{variant}-{steps}"
            score = train_and_score(data, folder, name, ("--max-num-iterations", str(steps), *flags), method)
            yield Row(**asdict(score), sweep="time", variant=variant, value=steps)


def main() -> None:
    """Run the benchmark in a folder that must not exist yet."""
    given = options(
        __doc__, sweeps=dict.fromkeys(SWEEPS), scene="cone-and-cylinder", seed=4, iterations=400,
        folder=Path("outputs/sweeps"), output=Path("benchmarks/results/sweeps.json"),
    )  # fmt: skip
    given.folder.mkdir(parents=True)
    rows: Rows[Row] = Rows(given.output, scene=given.scene, seed=given.seed, iterations=given.iterations)
    for sweep in given.sweeps:
        for row in over_time(given) if sweep == "time" else over_scans(given, sweep):
            rows.add(row)


if __name__ == "__main__":
    main()
