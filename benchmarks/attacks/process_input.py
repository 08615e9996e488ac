"""Flags of sl-process: lengths that are none, and paths to something else than what belongs there."""

import os
from collections.abc import Callable
from pathlib import Path

from benchmarks.attacks.case import Case
from benchmarks.attacks.commands import call
from benchmarks.attacks.expect import refused
from benchmarks.attacks.output_folders import PROCESS, left_behind, listing

GROUP = "Flags of sl-process"
_VALUES = (
    "1e400", "-1e400", "1e309", "1e308", "1e13", "1e-320", "1e-400", "1e-10", "0", "-0", "0.0", "-1", "-85", "nan",
    "inf", "-inf", "NaN", "1,5", "0x10", "1_0", "", " ", "1e", "e5", "--1", "85 85", "٨٥e400", "9" * 400, "9" * 5000,
)  # fmt: skip
_TEXTS = (
    "", " ", "85 mm", "baseline", "baseline of frame 0", "baseline of frame 0 = 85", "baseline of frame 0 = 85 inch",
    "baseline of frame 0 = 85 mm mm", "baseline of frame -1 = 85 mm", "baseline of frame 6 = 85 mm",
    "baseline of frame ² = 85 mm", "baseline of frame 0.0 = 85 mm", f"baseline of frame {'9' * 5000} = 85 mm",
    "baseline of frame frame_99999 = 85 mm", "distance between frame 0 (1, 2) and frame 9 (3, 4) = 5 mm",
    "distance between frame 0 (nan, 2) and frame 1 (3, 4) = 5 mm", "distance between frame 0 and frame 1 = 5 mm",
    "distance between frame 0 (1, 2) and frame 1 (3, 4) = 1e-320 mm", "x" * 100_000, "\udcff",
    "baseline of frame 0 = 85 mm; rm -rf /", "baseline of frame {0.__class__} = 85 mm", "%s%n",
)  # fmt: skip
_PATHS = (
    "missing", "", "/", "/dev/null", "/dev/zero", "/dev/random", "/proc/self/mem", "/proc/self/environ", "fifo", "loop",
    "dangling", "empty", "empty folder", "captures/pattern.png", "captures/images", "captures/images/frame_00000.png",
    "text", "n" * 300, "captures/pattern.json/x", "x\udcff", "locked",
)  # fmt: skip
_RESOLUTIONS = ("1024x768", "1x1", "0x0", "-5x5", "99999x99999", "1024x", "x768", "9" * 300 + "x768")
_FLAGS = ("--images", "--pattern", "--intrinsics", "--projector-intrinsics", "--masks", "--poses")
_RIGHT = {"--images": "captures/images"}


def cases() -> list[Case]:
    """Every wrong value of every flag."""
    lengths = [f"baseline of frame 0 = {value} mm" for value in _VALUES] + list(_TEXTS)
    found = [_refused(f"--known-length {_short(text)}", "--known-length", text) for text in lengths]
    found += [_refused(f"--jobs {value}", "--jobs", value) for value in ("0", "-1", "-99999999999", "9" * 5000)]
    found += [_refused(f"--pattern {value}", "--pattern", value) for value in _RESOLUTIONS]
    found += [_refused(f"--cell {value}", "--cell", value) for value in ("0", "-1", "2", "9" * 5000)]
    found += [_refused(f"--sequence {value}", "--sequence", value) for value in ("opencv", "OpenCV", "", "x" * 10_000)]
    for flag in _FLAGS:
        for path in _PATHS:
            if _RIGHT.get(flag) != path:
                found.append(_refused(f"{flag} {_short(path)}", flag, path))
    return found


def _refused(title: str, flag: str, value: str) -> Case:
    return Case(GROUP, title, ("captures",), _attack(flag, value))


def _attack(flag: str, value: str) -> Callable[[Path], str]:
    def attack(folder: Path) -> str:
        _lay_out(folder)
        before = listing(folder)
        done = call(folder, *_with(flag, value), seconds=30)
        if done.status == 2 and done.stderr.strip() and "Traceback" not in done.stderr:
            return left_behind(folder, before)  # refused by the parser of flags
        return refused(done) or left_behind(folder, before)

    return attack


def _with(flag: str, value: str) -> list[str]:
    command = [*PROCESS, "new"]
    if flag not in command:
        return [*command, f"{flag}={value}"]
    place = command.index(flag)
    return [*command[:place], *command[place + 2 :], f"{flag}={value}"]


def _lay_out(folder: Path) -> None:
    (folder / "text").write_text("mine")
    (folder / "empty").write_bytes(b"")
    (folder / "locked").write_text("{}")
    (folder / "locked").chmod(0)
    (folder / "empty folder").mkdir()
    (folder / "loop").symlink_to("loop")
    (folder / "dangling").symlink_to("/nonexistent/x")
    os.mkfifo(folder / "fifo")


def _short(text: str) -> str:
    shown = repr(text)
    return shown if len(shown) < 60 else f"{shown[:40]}... of {len(text)} characters"
