"""What `sl-process` makes of captures by a renderer that shares no code with it.

    python -m benchmarks.another_renderer [--sets mug box ...] [--which unseen] [--keep FOLDER] [--output FILE]

Each set has 24 photographs of 600 x 600 pixels (in the list `otherwise` some have others) of an object alone, on a
table or in a room. A frame of the scan is wrong if its camera or projector is turned by more than 3 degrees, or if it
puts the object off by more than 6 % of its size.
Sets that are in the output file already are not run again.
"""

import json
import resource
import shutil
import subprocess
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from benchmarks.another_renderer.scoring import FrameError, score, usable_frames
from benchmarks.another_renderer.sets import CaptureSet, captures_of, chosen_sets
from benchmarks.common.measuring import parsed, shown


@dataclass(frozen=True)
class Config:
    """Which sets are measured, and where they are kept."""

    sets: tuple[str, ...] = ()  # parts of the names of sets; default: all of the list
    # the first list (known); the second, at which nobody looks before a change is finished (unseen); other ways of
    # walking (otherwise); objects that came later (later); other cameras, projectors and matter (equipment)
    which: str = "known"
    keep: Path = Path("outputs/another_renderer")  # folder of captures and scans
    output: Path | None = None  # JSON with the figures; default: results.json in --keep
    jobs: int = 1  # processes of sl-process
    resume: bool = False  # use what an earlier run kept in its work folders; the time is then that of the rest


@dataclass(frozen=True)
class Row:
    """Figures of one set. Ratios are errors per axis over stated sigma: median, and 95 % of the frames."""

    name: str
    usable: int
    right: int
    wrong: tuple[str, ...]
    left_out: tuple[str, ...]
    camera_deg: tuple[float, float]  # median and worst of the frames in the scan, after alignment by cameras
    rotation_sigma: tuple[float, float]
    translation_sigma: tuple[float, float]
    relative_rotation_sigma: tuple[float, float]
    relative_translation_sigma: tuple[float, float]
    surface_median: float  # share of the object's size
    surface_95: float
    decoded: float
    wrong_pixels: float
    verdict: str
    seconds: float  # of processor time
    message: str
    errors: tuple[FrameError, ...]


def measure(one: CaptureSet, config: Config) -> Row:
    """Photographs, sl-process, comparison."""
    pattern = config.keep / "pattern"
    if not pattern.exists():
        _command("sl_nerfstudio.cli.pattern", "--output", str(pattern), "--width", "920", "--height", "920")
    captures = captures_of(one, pattern, config.keep)
    scan, work = (config.keep / "scans" / f"{one.name}{end}" for end in ("", ".work"))
    shutil.rmtree(scan, ignore_errors=True)
    if not config.resume:
        shutil.rmtree(work, ignore_errors=True)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    message = _command(
        "sl_nerfstudio.cli.process", "--images", str(captures / "images"), "--pattern", str(captures / "pattern.json"),
        "--intrinsics", str(captures / "intrinsics.json"), "--output", str(scan), "--work", str(work),
        "--jobs", str(config.jobs),
    )  # fmt: skip
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return row_of(one, scan, captures, seconds, message)


def row_of(one: CaptureSet, scan: Path, captures: Path, seconds: float, message: str) -> Row:
    """Figures; a frame in the scan that does not show the object counts as wrong if its verdict does not name it."""
    nan = float("nan"), float("nan")
    if message:
        usable = usable_frames(captures)
        return Row(one.name, len(usable), 0, (), usable, nan, nan, nan, nan, nan, nan[0], nan[0], 0.0, nan[0], "-",
                   seconds, message, ())  # fmt: skip
    found = score(scan, captures)
    right = {e.name for e in found.errors if e.right}
    kept = {e.name for e in found.errors} | set(found.unseen)
    e = found.errors
    return Row(
        one.name, len(found.usable), len(right & set(found.usable)), tuple(sorted(kept - right)),
        tuple(sorted(set(found.usable) - kept)), (_spread([x.camera_deg_by_cameras for x in e], 1.0)),
        _spread([x.rotation_sigma for x in e]), _spread([x.translation_sigma for x in e]),
        _spread([x.relative_rotation_sigma for x in e]), _spread([x.relative_translation_sigma for x in e]),
        found.surface_median, found.surface_95, found.decoded, found.wrong_pixels,
        json.loads((scan / "processing.json").read_text()).get("verdict", "-"), seconds, "", e,
    )  # fmt: skip


def _spread(values: list[float], upper: float = 0.95) -> tuple[float, float]:
    known = np.array(values)[np.isfinite(values)]
    return (float(np.median(known)), float(np.quantile(known, upper))) if len(known) else (float("nan"), float("nan"))


def _command(module: str, *flags: str) -> str:
    """Run a command of the package; what it says if it fails, else ""."""
    done = subprocess.run([sys.executable, "-m", module, *flags], capture_output=True, text=True, check=False)
    return "" if done.returncode == 0 else done.stderr.strip() or f"exit status {done.returncode}"


def main() -> None:
    """Print a line for each set, and write all to JSON."""
    config = parsed(Config, __doc__)
    cv2.setNumThreads(1)
    output = config.output or config.keep / "results.json"
    rows = json.loads(output.read_text()) if output.exists() else []
    for one in chosen_sets(config.sets, config.which):
        if any(row["name"] == one.name for row in rows):
            print(f"{one.name}: in {output} already", flush=True)
            continue
        row = measure(one, config)
        print(shown(replace(row, errors=())), flush=True)
        rows.append(asdict(row))
        output.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
