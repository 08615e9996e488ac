"""From photographs to scans: what `sl-process` makes of rendered captures of unseen objects, against the truth.

    python -m benchmarks.photographs [--sets frog chair-table ...] [--keep FOLDER] [--jobs 4] [--output FILE]

Each set has 24 captures of 600 x 600 pixels, with about 14 pixels a period. Sets differ in scene, surroundings and
appearance; some are shuffled, and not all of these say so. A frame of the scan is wrong if its camera or its projector
is turned by more than 3 degrees, or if it puts the object off by more than 6 % of its size.
"""

import json
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.common.measuring import Rows, parsed, shown
from benchmarks.common.runs import process
from benchmarks.photographs.scoring import (
    NOTHING_DECODED,
    DecodingFigures,
    PoseError,
    Truth,
    decoding_figures,
    pose_errors,
    read_truth,
)  # fmt: skip
from benchmarks.photographs.sets import CaptureSet, captures_of, chosen_sets
from sl_nerfstudio.cli.run import run
from sl_nerfstudio.scan import read_scan


@dataclass(frozen=True)
class Config:
    """Which sets are measured, and where their captures are kept."""

    # parts of the names of sets, for example "chair" or "realistic"; by default all. A full name that is not among
    # them, like "head-walls-hard-701-shuffled", is a new one: captures on which nothing was tuned
    sets: tuple[str, ...] = ()
    frames: int = 24  # captures of each set
    resolution: int = 600  # width of the images, pixels
    keep: Path = Path("outputs/photographs")  # folder in which captures are kept between runs
    scans: Path | None = None  # folder of the scans made from them; default: scans/ in the folder of the captures
    resume: bool = False  # use the frames that an earlier run decoded; the time is then that of the rest
    jobs: int = 4  # processes of sl-process
    render_only: bool = False  # render the captures that are missing, and stop
    output: Path | None = None


@dataclass(frozen=True)
class Row:
    """Figures of one set."""

    name: str
    appearance: str
    frames: int
    usable: int
    right: int  # usable frames in the scan and right
    wrong: tuple[str, ...]  # frames in the scan and not right
    left_out: int  # usable frames that are not in the scan
    decoded: float  # share of the object's lit pixels, over all usable frames
    median_px: float
    wrong_pixels: float  # share of the decoded ones that are more than 2 pattern pixels off
    slipped_pixels: float  # share of them that are more than half a period off
    camera_deg: float  # median over the right frames
    within_1_sigma: float  # share of the frames in the scan; camera rotation
    within_2_5_sigma: float
    verdict: str
    seconds: float
    errors: tuple[PoseError, ...]
    message: str  # of sl-process, if it made no scan


def measure(one: CaptureSet, config: Config) -> Row:
    """Process the captures of a set as a user does, and compare."""
    captures = captures_of(one, config.frames, config.resolution, config.keep)
    truth = read_truth(captures, one)
    output = (config.scans or config.keep / "scans") / captures.name
    work = output.with_name(output.name + ".work")
    shutil.rmtree(output, ignore_errors=True)
    if not config.resume:
        shutil.rmtree(work, ignore_errors=True)
    start = time.monotonic()
    message = process(captures, output, work, config.jobs, *("--unordered" for _ in range(one.unordered)))
    seconds = time.monotonic() - start
    found = read_scan(output) if message == "" else None
    errors = [] if found is None else pose_errors(found, truth)
    kept = () if found is None else tuple(frame.name for frame in found.frames)
    document = json.loads((output / "processing.json").read_text()) if message == "" else {}
    decoding = decoding_figures(work, truth) if (work / "manifest.json").exists() else None
    return row_of(one, truth, kept, errors, decoding, document.get("verdict", "-"), seconds, message)


def row_of(
    one: CaptureSet, truth: Truth, kept: tuple[str, ...], errors: list[PoseError], decoding: DecodingFigures | None,
    verdict: str, seconds: float, message: str,
) -> Row:  # fmt: skip
    """The figures of a set; a frame in the scan that does not show the object at all counts as wrong."""
    decoding = decoding or NOTHING_DECODED
    right = {error.name for error in errors if error.right}
    ratio = np.array([error.over_sigma for error in errors if np.isfinite(error.over_sigma)])
    usable = truth.usable
    return Row(
        name=one.name, appearance=one.appearance, frames=len(truth.frames), usable=len(usable),
        right=len(right & set(usable)), wrong=tuple(name for name in kept if name not in right),
        left_out=len(set(usable) - set(kept)), decoded=decoding.decoded, median_px=decoding.median_px,
        wrong_pixels=decoding.wrong, slipped_pixels=decoding.slipped,
        camera_deg=float(np.median([e.camera_deg for e in errors if e.right])) if right else float("nan"),
        within_1_sigma=float((ratio <= 1).mean()) if len(ratio) else float("nan"),
        within_2_5_sigma=float((ratio <= 2.5).mean()) if len(ratio) else float("nan"),
        verdict=verdict, seconds=seconds, errors=tuple(errors), message=message,
    )  # fmt: skip


def summary(rows: list[Row]) -> str:
    """A line for each appearance: all its frames together, medians of the rest."""
    lines = []
    for appearance in dict.fromkeys(row.appearance for row in rows):
        some = [row for row in rows if row.appearance == appearance]
        usable, right = sum(row.usable for row in some), sum(row.right for row in some)
        wrong = sum(len(row.wrong) for row in some)
        quiet = sum(len(row.wrong) for row in some if row.verdict in ("good", "acceptable"))
        values = [(r.decoded, r.median_px, r.wrong_pixels, r.slipped_pixels, r.camera_deg) for r in some]
        decoded, px, wrong_px, slipped, camera = (_median(column) for column in zip(*values, strict=True))
        lines.append(
            f"{appearance}: {right / usable:.1%} of the usable frames right, {wrong} wrong ({quiet} of them under good "
            f"or acceptable); medians over sets: decoded {decoded:.1%}, {px:.2f} px, {wrong_px:.2%} over 2 px, "
            f"{slipped:.2%} over 10 px, camera {camera:.3f} deg"
        )
    return "\n".join(lines)


def _median(values: Sequence[float]) -> float:
    """The median of those that exist."""
    known = [value for value in values if np.isfinite(value)]
    return float(np.median(known)) if known else float("nan")


def main() -> None:
    """Print a line for each set, and write all to JSON."""
    config = parsed(Config, __doc__)
    sets = chosen_sets(config.sets)
    if config.render_only:
        for one in sets:
            print(captures_of(one, config.frames, config.resolution, config.keep), flush=True)
        return
    rows: Rows[Row] = Rows(config.output, frames=config.frames, resolution=config.resolution)
    for one in sets:
        rows.add(measure(one, config), line=lambda row: shown(replace(row, errors=())))
    print(summary(rows))


if __name__ == "__main__":
    run(main)
