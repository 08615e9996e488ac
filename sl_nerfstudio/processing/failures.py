"""The errors of a run whose frames cannot make a scan: they say what happened to every frame."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.files.atomic import write_atomic
from sl_nerfstudio.processing.advice import first_line
from sl_nerfstudio.processing.config import ProcessConfig
from sl_nerfstudio.processing.frame_worker import FrameStageResult
from sl_nerfstudio.processing.given_poses import GivenPoses
from sl_nerfstudio.processing.preview import Preview
from sl_nerfstudio.processing.result import ProcessResult
from sl_nerfstudio.processing.summary import left_out
from sl_nerfstudio.registration.result import Registration

FEWEST_FRAMES = 2
REPORT = "processing.html"
_LISTED = 20  # frames in a message


def too_few_frames(
    result: ProcessResult, usable: int, make_report: Callable[[ProcessResult, Sequence[Preview]], str]
) -> UserError:
    """The error of a run in which fewer than two frames are usable; its report goes to the work folder."""
    config = result.config
    path = config.work_folder / REPORT
    write_atomic(path, make_report(result, [Preview(None, None)] * len(result.frames)).encode())
    lost = [frame for frame in result.frames if not frame.in_scan]
    first = lost[0].reason.strip().splitlines()[1:] if lost else []
    if result.contradiction:  # measured, and cause enough
        first = [f"    {line}" if k == 0 else line for k, line in enumerate(result.contradiction.splitlines())]
    return UserError(
        f"{config.images}: {usable} of {len(result.frames)} frames can be used, a scan needs at least "
        f"{FEWEST_FRAMES}\n"
        f"{_listed([f'{f.name}: {first_line(f.reason)}' for f in lost])}\n" + "\n".join(first) + f"\n    report: {path}"
    )


def require_given_poses(
    config: ProcessConfig, given: GivenPoses, results: Sequence[FrameStageResult], registration: Registration
) -> None:
    """Raise UserError unless at least two frames with given poses, at different places, were registered.

    `given` is in the order of `results`. Fewer poses determine neither axes nor unit.
    """
    path = Path() if config.poses is None else config.poses
    reasons = {result.name: left_out(result, registration) for result in results}
    with_pose = [r.name for r, pose in zip(results, given.known, strict=True) if pose]
    usable = [name for name in with_pose if reasons[name] is None]
    if len(usable) < FEWEST_FRAMES:
        lines = []
        for name in with_pose:
            failure = reasons[name]
            what = "registered" if failure is None else f"left out in {failure.stage}: {first_line(failure.reason)}"
            lines.append(f"{name}: {what}")
        raise UserError(
            f"{path}: {len(usable)} of the {len(with_pose)} frames with given poses could be registered, the axes and "
            f"the unit of the scan need at least {FEWEST_FRAMES}\n{_listed(lines)}\n"
            "    cause:  the frames with given poses are among those that cannot be used\n"
            "    remedy: give poses of other frames, capture these again, or leave --poses out"
        )
    chosen = np.array([name in usable for name in (r.name for r in results)])
    if not given.at_different_places(chosen):
        raise UserError(
            f"{path}: the given poses of the registered frames are all at the same place\n"
            "    cause:  frames with other positions are among those that cannot be used\n"
            "    remedy: give poses of other frames, capture those again, or leave --poses out"
        )


def _listed(lines: Sequence[str]) -> str:
    more = f"\n  and {len(lines) - _LISTED} more" if len(lines) > _LISTED else ""
    return "\n".join(f"  {line}" for line in lines[:_LISTED]) + more
