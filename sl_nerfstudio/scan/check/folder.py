"""The full check of a scan folder: everything `read_scan` checks, every pixel, and whether all of it fits together."""

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial as bound
from pathlib import Path

import numpy as np

from sl_nerfstudio.errors import Fault, ScanError
from sl_nerfstudio.progress import track
from sl_nerfstudio.scan.check.content import (
    FrameContent,
    PatternImage,
    check_content,
    check_pattern,
    duplicate_problems,
    read_shown,
)
from sl_nerfstudio.scan.check.conventions import convention_problems
from sl_nerfstudio.scan.check.image_problems import MatchedFrame, image_problems
from sl_nerfstudio.scan.check.interpretations import GeometricFit, fit_geometry
from sl_nerfstudio.scan.check.pattern_shift import shift_problems
from sl_nerfstudio.scan.document import TRANSFORMS
from sl_nerfstudio.scan.headers import check_headers
from sl_nerfstudio.scan.measured_length import measured_length
from sl_nerfstudio.scan.partial_frame import PartialFrame
from sl_nerfstudio.scan.partial_scan import PartialScan, read_partial_scan
from sl_nerfstudio.scan.pose_files import GROUND_TRUTH, read_ground_truth
from sl_nerfstudio.scan.problem import Faults
from sl_nerfstudio.scan.types import UNITS, Scan
from sl_nerfstudio.threads import results, threads


@dataclass(frozen=True)
class FolderCheck:
    """The result of a check: faults, or, if there are none, the scan with its figures."""

    faults: tuple[Fault, ...]
    scan: Scan | None  # None if there are faults
    fit: GeometricFit | None  # of the starting poses; None if there are faults
    contents: tuple[FrameContent, ...]


def check_folder(root: Path) -> FolderCheck:
    """Check a whole folder, with a progress bar; faults are returned, not raised. Memory holds a frame a thread."""
    root = Path(os.path.realpath(root))
    faults = Faults()
    partial = read_partial_scan(root, faults)
    good = check_headers(partial, faults)
    pattern = check_pattern(partial, good, faults)
    frames = list({frame.name: frame for frame in reversed(partial.frames)}.values())[::-1]  # a name twice is a fault
    contents = list(track(_contents(frames, partial, pattern, good, faults), "Checking the scan", len(frames)))
    for name, duplicate in duplicate_problems(contents):
        faults.add(duplicate, TRANSFORMS, name)
    for problem in shift_problems([content.shift for content in contents]):
        faults.add(problem, TRANSFORMS, None, "sl_coords_path")
    _check_conventions(partial, contents, faults)
    _check_images(frames, contents, good, faults)
    found = faults.found
    scan = None if found else partial.complete()
    if scan is not None:
        found = _faults_raised(lambda: _measure_scale_bar(scan)) + [
            replace(fault, file=f"{GROUND_TRUTH}/{fault.file}")
            for fault in _faults_raised(lambda: read_ground_truth(scan))
        ]
    if scan is None or found:
        return FolderCheck(tuple(found), None, None, tuple(contents))
    usable = [c.correspondences for c in contents if c.correspondences is not None]
    return FolderCheck((), scan, fit_geometry(usable, scan.projector), tuple(contents))


def _contents(
    frames: Sequence[PartialFrame],
    partial: PartialScan,
    pattern: PatternImage | None,
    good: set[Path],
    faults: Faults,
) -> Iterator[FrameContent]:
    """In threads; the faults come in the order of the frames, whichever was done first."""
    together = threads()
    for first in range(0, len(frames), together):
        group = frames[first : first + together]
        own = [Faults() for _ in group]
        pairs = zip(group, own, strict=True)
        yield from results([bound(check_content, frame, partial, pattern, good, f) for frame, f in pairs])
        for some in own:
            faults.take(some)


def check_scan(root: Path) -> list[Fault]:
    """All faults of a scan folder; empty if it is good."""
    return list(check_folder(root).faults)


def require_valid(root: Path) -> Scan:
    """The scan in a folder that passes the full check. Raises ScanError with all faults otherwise."""
    result = check_folder(root)
    if result.scan is None:
        raise ScanError(result.faults, str(root))
    return result.scan


def _check_conventions(partial: PartialScan, contents: list[FrameContent], faults: Faults) -> None:
    frames = [c.correspondences for c in contents if c.correspondences is not None]
    if partial.projector is None or not frames:
        return
    metres = None if partial.units is None else UNITS[partial.units]
    with np.errstate(all="ignore"):
        for frame, key, problem in convention_problems(frames, partial.projector, metres):
            faults.add(problem, TRANSFORMS, frame, key)


def _check_images(
    frames: Sequence[PartialFrame], contents: Sequence[FrameContent], good: set[Path], faults: Faults
) -> None:
    """Do the coordinates of each frame belong to its images? Not asked where another fault was found in them."""
    by_name = {frame.name: frame for frame in frames}
    matched = [MatchedFrame(content.name, content.match) for content in contents]
    found = dict(image_problems(matched, lambda name: read_shown(by_name[name], good)))
    captured = [MatchedFrame(content.name, content.image_match) for content in contents]
    found = {**dict(image_problems(captured, lambda _: None)), **found}
    explained = {fault.frame for fault in faults.found if fault.field == "sl_coords_path"}
    for content in contents:
        if content.name in found and not {content.name, None} & explained:
            faults.add(found[content.name], TRANSFORMS, content.name, "sl_coords_path")


def _measure_scale_bar(scan: Scan) -> None:
    """Raises ScanError if training could not measure the scan's scale bar."""
    if scan.scale.bar is not None:
        measured_length(scan, scan.scale.bar, scan.poses)


def _faults_raised(read: Callable[[], object]) -> list[Fault]:
    try:
        read()
    except ScanError as error:
        return error.faults
    return []
