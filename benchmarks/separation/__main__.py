"""Share of object pixels kept and of surroundings left in, on noisy coordinates of objects on tables and before walls.

    python -m benchmarks.separation [--objects frog medal ...] [--backgrounds none table walls ...] [--zoom 0.75]

Coordinates are cast on the mesh (24 frames of 300 x 300) and disturbed: 0.3 px noise, 15 % of cells missing, 2 % wrong;
those that contradict the epipolar geometry by more than 1.5 px are dropped, as sl-process does. Frames as wholes are
wrong by `--pose-deg` about the object, and by a ninth of that in their position as seen from there.
"""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.common.measuring import Rows, options
from benchmarks.separation.cases import Conditions, make_case
from benchmarks.separation.objects import BACKGROUNDS, OBJECTS
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


def measure(name: str, background: str, given: Conditions) -> Row:
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
    return Row(
        name, background, object_kept=float(kept.sum() / total.sum()),
        object_kept_worst=float((kept / total.clip(1)).min()),
        surroundings_left=float(left.sum() / max(others.sum(), 1)),
        surroundings_share=float(others.sum() / (others.sum() + total.sum())),
        verdicts=tuple(f.verdict for f in found.findings), seconds=seconds,
    )  # fmt: skip


def main() -> None:
    """Measure all cases and write them. With a zoom below 1, devices see more of the surroundings."""
    given = options(
        __doc__, objects=OBJECTS, backgrounds=dict.fromkeys(BACKGROUNDS), zoom=0.75, pose_deg=0.05, noise_px=0.3,
        seed=0, output=Path("benchmarks/results/separation.json"),
    )  # fmt: skip
    conditions = Conditions(zoom=given.zoom, pose_deg=given.pose_deg, noise_px=given.noise_px, seed=given.seed)
    rows: Rows[Row] = Rows(given.output, **vars(conditions))
    for name in given.objects:
        for background in given.backgrounds:
            rows.add(measure(name, background, conditions))


if __name__ == "__main__":
    main()
