"""The full check of a scan folder: everything `read_scan` sees, every pixel, and how all of it fits together."""

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sl_nerfstudio.errors import Fault, ScanError
from sl_nerfstudio.progress import track
from sl_nerfstudio.scan.check.content import FrameContent, check_content, check_pattern, duplicate_problems
from sl_nerfstudio.scan.check.conventions import convention_problems
from sl_nerfstudio.scan.check.pattern_shift import shift_problems
from sl_nerfstudio.scan.check.readings import ReadingFit, fit_reading
from sl_nerfstudio.scan.headers import check_headers
from sl_nerfstudio.scan.partial_scan import TRANSFORMS, PartialScan, read_partial_scan
from sl_nerfstudio.scan.pose_files import GROUND_TRUTH, read_ground_truth
from sl_nerfstudio.scan.problem import Faults
from sl_nerfstudio.scan.types import UNITS, Scan


@dataclass(frozen=True)
class Examination:
    """What a check found: faults, and, where there are none, the scan with its figures."""

    faults: tuple[Fault, ...]
    scan: Scan | None  # None if there are faults
    fit: ReadingFit | None  # of the starting poses; None if there are faults
    contents: tuple[FrameContent, ...]


def examine(root: Path) -> Examination:
    """Check a folder wholly, with progress; never raises for a faulty scan. Holds one frame in memory at a time."""
    root = Path(os.path.realpath(root))
    faults = Faults()
    draft = read_partial_scan(root, faults)
    good = check_headers(draft, faults)
    pattern = check_pattern(draft, good, faults)
    contents = [check_content(f, draft, pattern, good, faults) for f in track(draft.frames, "Checking the scan")]
    for name, duplicate in duplicate_problems(contents):
        faults.add(duplicate, TRANSFORMS, name)
    for problem in shift_problems([content.shift for content in contents]):
        faults.add(problem, TRANSFORMS, None, "sl_coords_path")
    _check_conventions(draft, contents, faults)
    if faults.found:
        return Examination(tuple(faults.found), None, None, tuple(contents))
    scan = draft.complete()
    try:
        read_ground_truth(scan)
    except ScanError as error:
        found = tuple(replace(fault, file=f"{GROUND_TRUTH}/{fault.file}") for fault in error.faults)
        return Examination(found, None, None, tuple(contents))
    usable = [c.correspondences for c in contents if c.correspondences is not None]
    return Examination((), scan, fit_reading(usable, scan.projector), tuple(contents))


def check_scan(root: Path) -> list[Fault]:
    """All faults of a scan folder, an empty list for a good one."""
    return list(examine(root).faults)


def require_valid(root: Path) -> Scan:
    """The scan in a folder that passes the full check. Raises ScanError with all faults otherwise."""
    result = examine(root)
    if result.scan is None:
        raise ScanError(result.faults, str(root))
    return result.scan


def _check_conventions(draft: PartialScan, contents: list[FrameContent], faults: Faults) -> None:
    frames = [c.correspondences for c in contents if c.correspondences is not None]
    if draft.projector is None or not frames:
        return
    metres = None if draft.units is None else UNITS[draft.units]
    with np.errstate(all="ignore"):
        for frame, key, problem in convention_problems(frames, draft.projector, metres):
            faults.add(problem, TRANSFORMS, frame, key)
