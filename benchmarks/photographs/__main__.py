"""From photographs to scans: what `sl-process` makes of rendered captures of unseen objects, against the truth.

    python -m benchmarks.photographs [--sets frog chair-table parts ...] [--until registered] [--keep FOLDER]

Each set has 24 captures of 600 x 600 pixels, with about 14 pixels a period. Sets differ in scene, surroundings and
appearance; some are shuffled, and not all of these say so. A frame of the scan is wrong if its camera or its projector
is turned by more than 3 degrees, or if it puts the object off by more than 6 % of its size.

Decoded frames are kept in the folders of the captures: with `--until registered`, registration alone takes a minute a
set, and `--until adjusted` adds the joint adjustment.
"""

import json
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.common.measuring import Rows, parsed
from benchmarks.common.runs import process
from benchmarks.photographs.scoring import (
    NOTHING_DECODED,
    DecodingFigures,
    FoundFrame,
    PoseError,
    Truth,
    decoding_figures,
    group_sizes,
    pose_errors,
    read_truth,
)  # fmt: skip
from benchmarks.photographs.sets import WORK, chosen_captures, note_of
from sl_nerfstudio.cli.run import run
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.processing.config import ProcessConfig
from sl_nerfstudio.processing.consistency import adjust_consistent, registered_only
from sl_nerfstudio.processing.frames import captures_of, clouds_of
from sl_nerfstudio.processing.inputs import read_inputs
from sl_nerfstudio.processing.process import register_clouds
from sl_nerfstudio.processing.projector import calibrate_frames
from sl_nerfstudio.registration.register import chosen_clouds
from sl_nerfstudio.scan import read_scan

_BEYOND = 3.0  # stated sigma, per axis
_STEPS = ("rendered", "decoded", "registered", "adjusted", "scan")


@dataclass(frozen=True)
class Config:
    """Which sets are measured, how far, and where their captures are kept."""

    # lists of sets (objects, parts, unseen-parts), parts of the names of sets, as "chair" or "realistic", and folders
    # in --keep. A full name that is in no list, as "head-walls-hard-701-shuffled" or "gear-none-plain-720-half", is a
    # new set: captures on which nothing was tuned
    sets: tuple[str, ...] = ("objects",)
    until: str = "scan"  # rendered, decoded, registered, adjusted (without the command), scan (by sl-process)
    frames: int = 24  # captures of each set
    resolution: int = 600  # width of the images, pixels
    keep: Path = Path("outputs/photographs")  # folder in which captures and decoded frames are kept between runs
    decode_again: bool = False  # with this, the time is that of everything
    jobs: int = 4  # processes that decode
    output: Path | None = None


@dataclass(frozen=True)
class Row:
    """Figures of one set."""

    name: str
    appearance: str
    frames: int
    usable: int
    placed: int  # in the scan
    right: int  # usable frames in the scan and right
    wrong: tuple[str, ...]  # frames in the scan and not right
    beyond: tuple[str, ...]  # frames in the scan whose camera is turned by more than 3 stated sigma
    left_out: int  # usable frames that are not in the scan
    groups: tuple[int, ...]  # sizes of the groups of frames that are turned rightly against each other
    decoded: float  # share of the object's lit pixels, over all usable frames
    median_px: float
    wrong_pixels: float  # share of the decoded ones that are more than 2 pattern pixels off
    slipped_pixels: float  # share of them that are more than half a period off
    camera_deg: float  # median over the right frames
    sigma_deg: float  # median of what is stated for the frames in the scan, per axis
    within_1_sigma: float  # share of the frames in the scan; camera rotation
    within_2_5_sigma: float
    verdict: str  # of sl-process; without it, what registration says of turns and order
    seconds: float
    errors: tuple[PoseError, ...]
    message: str  # why there is no scan


def measure(captures: Path, config: Config) -> Row:
    """Go as far as asked for with the captures of a set, and compare."""
    truth, work = read_truth(captures), captures / WORK
    if config.decode_again:
        shutil.rmtree(work, ignore_errors=True)
    start = time.monotonic()
    try:
        step = _by_sl_process if config.until == "scan" else _in_this_process
        found, verdict, message = *step(captures, config), ""
    except UserError as error:
        found, verdict, message = [], "-", str(error)
    seconds = time.monotonic() - start
    decoding = decoding_figures(work, truth) if (work / "manifest.json").exists() else None
    return row_of(captures, truth, found, decoding, verdict, seconds, message)


def _by_sl_process(captures: Path, config: Config) -> tuple[Sequence[FoundFrame], str]:
    """The frames of the scan that a user gets, and its verdict. Raises UserError with the words of the command."""
    output, work = captures / "scan", captures / WORK
    shutil.rmtree(output, ignore_errors=True)
    for stage in ("registration", "adjustment"):
        for kept in work.glob(f"stages/{stage}-*"):
            kept.unlink()
    message = process(captures, output, work, config.jobs, *["--unordered"] * note_of(captures)["unordered"])
    if message:
        raise UserError(message)
    frames = [FoundFrame(f.name, f.T_world_camera, f.T_world_projector, f.pose_sigma) for f in read_scan(output).frames]
    return frames, json.loads((output / "processing.json").read_text())["verdict"]


def _in_this_process(captures: Path, config: Config) -> tuple[Sequence[FoundFrame], str]:
    """The frames that were registered, and adjusted if asked for, as `sl-process` does it; and what it says of them."""
    job = ProcessConfig(
        images=captures / "images", pattern=captures / "pattern.json", intrinsics=captures / "intrinsics.json",
        output=captures / "scan", work=captures / WORK, jobs=config.jobs, unordered=note_of(captures)["unordered"],
    )  # fmt: skip
    results = calibrate_frames(job, read_inputs(job), _silent).results
    clouds = clouds_of(results)
    if config.until == "decoded":
        return [], "-"
    chosen, found = register_clouds(clouds, captures_of(results), job.unordered, job.seed, None, _silent)
    clouds = chosen_clouds(clouds, chosen)
    adjust = config.until == "adjusted"
    kept = adjust_consistent(clouds, found, _silent) if adjust else registered_only(clouds, found)
    index, poses = np.flatnonzero(kept.registration.registered).tolist(), kept.adjusted.poses
    frames = [
        FoundFrame(clouds[k].name, poses.T_world_camera[k], poses.T_world_projector[k], kept.adjusted.sigma[k])
        for k in index
    ]
    says = (
        *(f"{turn:.0f} deg" for turn in found.turns_deg),
        "by order" * bool(found.by_order),
        "mixed" * (not found.ordered),
    )
    return frames, ", ".join(filter(None, says)) or "-"


def _silent(_: str) -> None:
    """Take a line of the log."""


def row_of(
    captures: Path, truth: Truth, found: Sequence[FoundFrame], decoding: DecodingFigures | None, verdict: str,
    seconds: float, message: str,
) -> Row:  # fmt: skip
    """The figures of a set; a frame in the scan that does not show the object at all counts as wrong."""
    decoding, errors = decoding or NOTHING_DECODED, pose_errors(found, truth)
    ratio = np.array([error.over_sigma for error in errors if np.isfinite(error.over_sigma)])
    right, kept, usable = {error.name for error in errors if error.right}, [f.name for f in found], truth.usable
    return Row(
        name=captures.name, appearance=note_of(captures)["appearance"],
        frames=len(truth.frames), usable=len(usable), placed=len(found), right=len(right & set(usable)),
        wrong=tuple(name for name in kept if name not in right),
        beyond=tuple(e.name for e in errors if e.over_sigma > _BEYOND), left_out=len(set(usable) - set(kept)),
        groups=group_sizes(found, truth), decoded=decoding.decoded, median_px=decoding.median_px,
        wrong_pixels=decoding.wrong, slipped_pixels=decoding.slipped,
        camera_deg=_median([e.camera_deg for e in errors if e.right]), sigma_deg=_median([e.sigma_deg for e in errors]),
        within_1_sigma=float((ratio <= 1).mean()) if len(ratio) else float("nan"),
        within_2_5_sigma=float((ratio <= 2.5).mean()) if len(ratio) else float("nan"),
        verdict=verdict, seconds=seconds, errors=tuple(errors), message=message,
    )  # fmt: skip


_HEAD = ("set", "usable", "placed", "right", "wrong", "> 3 sigma", "error", "sigma", "seconds", "verdict", "groups")
_LINE = "{:42} {:>6} {:>6} {:>6} {:>6} {:>9} {:>7} {:>7} {:>8}  {:16} {}"


def line(row: Row) -> str:
    """A row as a line of the table; errors in degrees, over the right frames; sigma over those in the scan."""
    groups = " ".join(map(str, row.groups)) + row.message.partition("\n")[0]
    return _LINE.format(
        row.name, row.usable, row.placed, row.right, len(row.wrong), len(row.beyond), f"{row.camera_deg:.3f}",
        f"{row.sigma_deg:.3f}", f"{row.seconds:.0f}", row.verdict, groups,
    )  # fmt: skip


def summary(rows: list[Row]) -> str:
    """A line for each appearance: all its frames together, medians of the rest."""
    lines = []
    for appearance in dict.fromkeys(row.appearance for row in rows):
        some = [row for row in rows if row.appearance == appearance]
        usable, right = sum(row.usable for row in some), sum(row.right for row in some)
        wrong, beyond = sum(len(row.wrong) for row in some), sum(len(row.beyond) for row in some)
        quiet = sum(len(row.wrong) for row in some if row.verdict in ("good", "acceptable"))
        values = [(r.decoded, r.median_px, r.wrong_pixels, r.slipped_pixels, r.camera_deg) for r in some]
        decoded, px, wrong_px, slipped, camera = (_median(column) for column in zip(*values, strict=True))
        lines.append(
            f"{appearance}: {right / usable:.1%} of the usable frames right, {wrong} wrong ({quiet} of them under good "
            f"or acceptable), {beyond} beyond {_BEYOND:.0f} sigma; medians over sets: decoded {decoded:.1%}, "
            f"{px:.2f} px, {wrong_px:.2%} over 2 px, {slipped:.2%} over 10 px, camera {camera:.3f} deg"
        )
    return "\n".join(lines)


def _median(values: Sequence[float]) -> float:
    """The median of those that exist."""
    known = [value for value in values if np.isfinite(value)]
    return float(np.median(known)) if known else float("nan")


def main() -> None:
    """Print a line for each set, and write all to JSON."""
    config = parsed(Config, __doc__)
    if config.until not in _STEPS:
        raise UserError(f"--until {config.until}: give one of {', '.join(_STEPS)}")
    rows: Rows[Row] = Rows(config.output, until=config.until, frames=config.frames, resolution=config.resolution)
    print(_LINE.format(*_HEAD))
    for captures in chosen_captures(config.sets, config.frames, config.resolution, config.keep):
        if config.until == "rendered":
            print(captures, flush=True)
        else:
            rows.add(measure(captures, config), line=line)
    if rows:
        print(summary(rows))


if __name__ == "__main__":
    run(main)
