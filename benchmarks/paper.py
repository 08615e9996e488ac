"""The experiments of the paper (Furukawa et al. 2025) on rendered stand-ins, with its method, ours and fusion.

    python -m benchmarks.paper table1|ablation|real|chain [--resolution 1200] [--steps 10000] [--methods NAME ...]

`table1`: its cone-and-cylinder. `ablation`: its method without one part of it. `real`: a head and a frog for its bust
and its frog, with the usual decoding noise and with most cells not decoded, or decoded wrongly. `chain`: photographs
registered by ICP, then joint rendering. The methods are `tracked` (fusion frame to model, as KinectFusion does it),
`registered` (fusion after ICP), `sl-neus`, and `sl-neus-paper` with `--steps`. Prints a table and writes
benchmarks/results/paper_NAME.json. Rows that are there are not measured again.
"""

import shutil
import sys
from argparse import Namespace
from collections.abc import Iterator
from dataclasses import astuple, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks import accuracy, tsdf_baseline
from benchmarks.common.measuring import Rows, kept_rows, markdown, options, shown
from benchmarks.common.runs import process, run
from sl_nerfstudio.cli.run import run as run_main
from sl_nerfstudio.errors import UserError

METHODS = ("tracked", "registered", "sl-neus", "sl-neus-paper")
_SHARES = (0.3, 0.6, 0.9)
DECODING: dict[str, tuple[object, ...]] = {
    "usual": (),
    **{f"{share:.0%} missing": ("--missing", share) for share in _SHARES},
    **{f"{share:.0%} wrong": ("--wrong", share, "--missing", 0) for share in _SHARES},
}
_SL_NEUS_STEPS = 1000  # those that it recommends
_ABLATION = ("refined", "no-pattern", "unrefined", "no-annealing")  # the paper's, in its order
EXPERIMENTS = {
    "table1": (("cone-and-cylinder",), METHODS, ("usual",), ("refined",)),
    "ablation": (("cone-and-cylinder",), ("sl-neus-paper",), ("usual",), _ABLATION),
    "real": (("head", "frog"), METHODS, tuple(DECODING), ("refined",)),
    "chain": (("cone-and-cylinder",), ("initial", "sl-neus-paper", "sl-neus"), ("photographs",), ("refined",)),
}
"""Scenes, methods, decoding and parts left out; `initial` is fusion with the poses that sl-process found."""


@dataclass(frozen=True)
class Case:
    """What was run on what."""

    scene: str
    frames: int
    resolution: int
    seed: int
    decoding: str
    method: str
    variant: str
    steps: int  # of training; 0 for fusion


@dataclass(frozen=True)
class Errors:
    """Errors of one case; lengths in mm."""

    rigid_rmse: float
    rigid_median: float
    similarity_rmse: float
    completeness_rmse: float
    camera_mm: float
    camera_deg: float
    seconds: float  # of fusion, or of the whole training command


@dataclass(frozen=True)
class Row:
    """One case; errors are None if a command failed, and `fault` is what it said."""

    case: Case
    errors: Errors | None
    fault: str = ""


def _row(case: dict[str, Any], errors: dict[str, Any] | None, fault: str) -> Row:
    return Row(Case(**case), Errors(**errors) if errors else None, fault)


def cases(name: str, given: Namespace) -> Iterator[Case]:
    """Those of an experiment; the ones that share a scan come one after the other."""
    scenes, methods, decodings, variants = EXPERIMENTS[name]
    for scene in given.scenes or scenes:
        for seed in given.seeds:
            for decoding in given.decoding or decodings:
                for method in given.methods or methods:
                    steps = {"sl-neus": given.sl_neus_steps, "sl-neus-paper": given.steps}.get(method, 0)
                    for variant in given.variants or variants:
                        frames = given.frames or accuracy.FRAMES[scene]
                        yield Case(scene, frames, given.resolution, seed, decoding, method, variant, steps)


def make(case: Case, scan: Path) -> None:
    """The scan of a case; from photographs with poses by ICP alone, and lengths in its own unit."""
    size = ("--scene", case.scene, "--frames", case.frames, "--resolution", case.resolution, "--seed", case.seed)
    if case.decoding != "photographs":
        run("sl-synth", "--output", scan, *size, *DECODING[case.decoding])
        return
    captures = scan.parent / "captures"
    run("sl-synth", "--output", captures, *size, "--images-only")
    fault = process(captures, scan, scan.parent / "work", 1, "--no-adjust")
    if fault:
        raise UserError(f"{captures}: sl-process made no scan\n{fault}")
    shutil.copytree(captures / "ground_truth", scan / "ground_truth", dirs_exist_ok=True)


def measure(case: Case, scan: Path, folder: Path) -> Errors:
    """Run the method of a case on its scan. Raises UserError or SystemExit if that fails."""
    if case.steps:
        ((_, found),) = accuracy.scored(scan, folder, case.method, case.steps, (case.variant,))
        return Errors(
            found.rigid_rmse, found.rigid_median, found.similarity_rmse, found.completeness_rmse,
            found.camera_translation_rmse, found.camera_rotation_rmse_deg, found.training_seconds,
        )  # fmt: skip
    (fused,) = tsdf_baseline.measure(scan, (case.method,))
    return Errors(
        fused.accuracy_rmse, fused.accuracy_median, fused.accuracy_rmse_similarity, fused.completeness_rmse,
        fused.camera_translation_rmse, fused.camera_rotation_rmse_deg, fused.seconds,
    )  # fmt: skip


def measured(case: Case, scan: Path, folder: Path) -> Row:
    """A row, also if the scan cannot be made or the method fails on it."""
    try:
        if not scan.exists():
            make(case, scan)
        return Row(case, measure(case, scan, folder))
    except (UserError, SystemExit) as fault:
        return Row(case, None, str(fault))


def table(rows: list[Row]) -> str:
    """All rows; failures by their last line."""
    head = [*Case.__dataclass_fields__, *Errors.__dataclass_fields__]
    empty = len(Errors.__dataclass_fields__) - 1
    lines = [
        [
            *map(str, astuple(row.case)),
            *([f"{x:.3g}" for x in astuple(row.errors)] if row.errors
              else [f"failed: {row.fault.strip().splitlines()[-1]}", *[""] * empty]),
        ]
        for row in rows
    ]  # fmt: skip
    return markdown(head, lines)


def main() -> None:
    """Run one experiment."""
    name = sys.argv.pop(1) if sys.argv[1:] and not sys.argv[1].startswith("-") else ""
    given = options(
        __doc__, scenes=(), methods=(), variants=(), decoding=(), seeds=[4], resolution=400, frames=0,
        steps=10_000, sl_neus_steps=_SL_NEUS_STEPS, output=Path,
    )  # fmt: skip
    allowed = {
        "scenes": accuracy.FRAMES, "methods": tsdf_baseline.POSES | dict.fromkeys(METHODS),
        "variants": accuracy.VARIANTS, "decoding": DECODING,
    }  # fmt: skip
    faults = [] if name in EXPERIMENTS else [f"{name!r}: name an experiment first: {', '.join(EXPERIMENTS)}"]
    for flag, names in allowed.items():
        if unknown := sorted(set(getattr(given, flag)) - set(names)):
            faults.append(f"--{flag} {' '.join(unknown)}: unknown\n    remedy: choose from {', '.join(names)}")
    if faults:
        raise UserError("\n".join(faults))
    output = given.output or Path(f"benchmarks/results/paper_{name}.json")
    rows: Rows[Row] = Rows(output, kept_rows(output, _row))
    with TemporaryDirectory() as parent:
        for number, case in enumerate(cases(name, given)):
            if not rows.have(case=case):
                scan = Path(parent) / f"{case.scene}-{case.seed}-{case.decoding.replace(' ', '-')}"
                scan.mkdir(exist_ok=True)
                folder = Path(parent) / str(number)
                folder.mkdir()
                rows.add(measured(case, scan / "scan", folder), line=lambda row: shown(row.errors or row))
    print(table(rows))


if __name__ == "__main__":
    run_main(main)
