"""Share of object pixels kept and of surroundings left in, on noisy coordinates of objects on tables and before walls.

    python -m benchmarks.separation [--objects frog medal ...] [--backgrounds none table walls ...] [--zoom 0.75]

Coordinates are cast on the mesh (24 frames of 300 x 300) and disturbed: 0.3 px noise, 15 % of cells missing, 2 % wrong;
those that contradict the epipolar geometry by more than 1.5 px are dropped, as sl-process does. Frames as wholes are
wrong by `--pose-deg` about the object, and by a ninth of that in their position as seen from there.
"""

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.common.machine import write_rows
from benchmarks.separation.cases import Conditions, make_case
from benchmarks.separation.objects import BACKGROUNDS, OBJECTS
from sl_nerfstudio.object_separation.planes import PlaneFinding
from sl_nerfstudio.object_separation.separate import Part, separate


@dataclass(frozen=True)
class Row:
    """One object before one background; pixels are decoded ones."""

    object: str
    background: str
    object_kept: float  # share of the object's pixels
    object_kept_worst: float  # in the worst frame
    surroundings_left: float  # share of the pixels of the surroundings
    surroundings_share: float  # of all pixels
    verdicts: tuple[str, ...]  # of the planes
    seconds: float


def measure(name: str, background: str, given: Conditions) -> tuple[Row, tuple[PlaneFinding, ...]]:
    """Separate one case and compare."""
    case = make_case(OBJECTS[name](), background, given)
    start = time.monotonic()
    found = separate(case.frames)
    seconds = time.monotonic() - start
    kept, total, left, others = np.zeros((4, len(case.frames)))
    for k, (frame, is_object) in enumerate(zip(case.frames, case.is_object, strict=True)):
        decoded = np.isfinite(frame.coords).all(-1)
        shown = found.parts(k, frame) == Part.OBJECT
        kept[k], total[k] = (shown & decoded & is_object).sum(), (decoded & is_object).sum()
        left[k], others[k] = (shown & decoded & ~is_object).sum(), (decoded & ~is_object).sum()
    row = Row(
        name,
        background,
        object_kept=float(kept.sum() / total.sum()),
        object_kept_worst=float((kept / total.clip(1)).min()),
        surroundings_left=float(left.sum() / max(others.sum(), 1)),
        surroundings_share=float(others.sum() / (others.sum() + total.sum())),
        verdicts=tuple(f.verdict for f in found.findings),
        seconds=seconds,
    )
    return row, found.findings


def describe(row: Row) -> str:
    """One line."""
    return (
        f"{row.object:18} {row.background:6} object kept {row.object_kept:7.2%} (worst frame "
        f"{row.object_kept_worst:7.2%}), of the surroundings ({row.surroundings_share:3.0%}) left "
        f"{row.surroundings_left:6.2%}  {row.seconds:4.1f} s"
    )


def describe_plane(f: PlaneFinding) -> str:
    """One line."""
    return (
        f"    {f.verdict:22} share {f.share:.2f} front {f.cameras_in_front:.2f} behind {f.behind:.3f} "
        f"above {f.above:.3f} continues {f.continues:.2f} area {f.area_ratio:.1f} "
        f"height {f.height_ratio:.2f} around {f.around:.2f}"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure all cases and write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", nargs="+", default=list(OBJECTS), choices=list(OBJECTS))
    parser.add_argument("--backgrounds", nargs="+", default=list(BACKGROUNDS), choices=list(BACKGROUNDS))
    parser.add_argument("--zoom", type=float, default=0.75, help="below 1, devices see more of the surroundings")
    parser.add_argument("--pose-deg", type=float, default=0.05, help="error of each frame about the object")
    parser.add_argument("--noise-px", type=float, default=0.3, help="noise of coordinates")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/separation.json"))
    parser.add_argument("--verbose", action="store_true", help="print every plane")
    flags = parser.parse_args(arguments)
    given = Conditions(zoom=flags.zoom, pose_deg=flags.pose_deg, noise_px=flags.noise_px, seed=flags.seed)
    rows = []
    for name in flags.objects:
        for background in flags.backgrounds:
            row, planes = measure(name, background, given)
            rows.append(row)
            print("\n".join([describe(row), *(map(describe_plane, planes) if flags.verbose else ())]), flush=True)
    write_rows(flags.output, rows, **vars(given))


if __name__ == "__main__":
    main()
