"""An open benchmark of scanning with a moving projector: ten scans with truth, for any method (docs/benchmark.md).

    python -m benchmarks.open make  --output DATA
    python -m benchmarks.open run   --data DATA --method sl-neus --results RESULTS      ours, the paper's, and fusion
    python -m benchmarks.open score --data DATA --results RESULTS [RESULTS ...]         of any method

RESULTS has a folder for each scan, named like it, with mesh.ply and transforms.json (or cameras.txt, TUM's format).
`make` and `run` go on where they were interrupted.
"""

import argparse
import json
from dataclasses import asdict, dataclass
from pathlib import Path

from benchmarks.common.measuring import Rows, markdown
from benchmarks.open.methods import METHODS, RECORD, Job, hand_in
from benchmarks.open.scans import INDEX, SCANS, VERSION, checksum, chosen_scans, make, published
from benchmarks.open.scoring import ScanFigures, score
from sl_nerfstudio.cli.run import run
from sl_nerfstudio.errors import UserError


@dataclass(frozen=True)
class Row(ScanFigures):
    """One result; `published` says whether its scan is the one of the published figures, byte for byte."""

    results: str  # name of the folder
    seconds: float | None
    steps: int | None
    published: bool


def make_scans(options: argparse.Namespace) -> None:
    """Make the scans, and say which differ from the published ones."""
    document = make(chosen_scans(options.scans), options.output)
    known = published()
    for name, found in document["scans"].items():
        print(f"{name:18} {found[:16]} {'as published' if found == known.get(name) else 'not the published bytes'}")
    if any(found != known.get(name) for name, found in document["scans"].items()):
        print("other versions of numpy, open3d or OpenCV round differently: say so with your figures")
    print(f"wrote {options.output / INDEX}")


def run_method(options: argparse.Namespace) -> None:
    """Run a method on all scans that have no result of it yet."""
    for scan in chosen_scans(options.scans):
        folder = options.results / scan.name
        if (folder / RECORD).exists():
            continue
        if folder.exists():
            raise UserError(f"{folder}: an interrupted run left it\n    remedy: remove it")
        seconds = hand_in(Job(scan, options.method, options.data, folder, options.steps))
        print(f"{options.method} on {scan.name}: {seconds:.0f} s", flush=True)


def score_results(options: argparse.Namespace) -> None:
    """Score all results, naming scans without one; print a table; write the figures."""
    rows: Rows[Row] = Rows(options.json, version=VERSION)
    known = published()
    for results in options.results:
        for scan in chosen_scans(options.scans):
            folder = results / scan.name
            if not (folder / "mesh.ply").exists():
                print(f"{results.name}: no {scan.name}/mesh.ply")
                continue
            record = json.loads((folder / RECORD).read_text()) if (folder / RECORD).exists() else {}
            rows.add(Row(
                **asdict(score(scan, options.data, folder)), results=results.name, seconds=record.get("seconds"),
                steps=record.get("steps"), published=checksum(options.data / scan.name) == known.get(scan.name),
            ))  # fmt: skip
    if not rows:
        raise UserError("no result has a mesh.ply\n    remedy: name the folders like the scans: RESULTS/SCAN/mesh.ply")
    print(table(rows))


def table(rows: list[Row]) -> str:
    """Markdown: a line for each scan; accuracy (RMSE), completeness (mean), cameras."""
    columns = list(dict.fromkeys(row.results for row in rows))

    def cell(row: Row | None) -> str:
        if row is None:
            return ""
        cameras = "" if row.camera_mm is None else f"; {row.camera_mm:.2f} mm, {row.camera_deg:.3f} deg"
        lost = f" ({row.frames} of {row.all_frames})" if row.frames < row.all_frames else ""
        return f"{row.accuracy_rmse:.3f} / {row.completeness_mean:.3f}{cameras}{lost}"

    found = {(row.scan, row.results): row for row in rows}
    scans = [scan.name for scan in SCANS if any(row.scan == scan.name for row in rows)]
    return markdown(["scan", *columns], [[scan, *(cell(found.get((scan, c))) for c in columns)] for scan in scans])


def main() -> None:
    """Parse the command line, and do what it asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    making, running, scoring = (commands.add_parser(name) for name in ("make", "run", "score"))
    making.add_argument("--output", type=Path, required=True, help="folder of the scans")
    running.add_argument("--method", required=True, choices=METHODS)
    running.add_argument("--results", type=Path, required=True, help="folder of the method's results")
    running.add_argument("--steps", type=int, help="of training; default: what the method recommends")
    scoring.add_argument("--results", type=Path, nargs="+", required=True, help="folders of results, one for a method")
    scoring.add_argument("--json", type=Path, help="where to write the figures")
    for command, do in ((making, make_scans), (running, run_method), (scoring, score_results)):
        command.set_defaults(do=do)
        command.add_argument("--scans", nargs="+", default=[], help="names of scans; default: all")
        if command is not making:
            command.add_argument("--data", type=Path, required=True, help="folder of the scans")
    options = parser.parse_args()
    run(lambda: options.do(options))


if __name__ == "__main__":
    main()
