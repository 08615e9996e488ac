"""Flags that cannot be: unknown, missing, out of range; outputs where nothing can be written; full disks; odd names."""

import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from benchmarks.attacks.commands import Case, Fixture, accepted, call, left_behind, listing, refused

GROUP = "Output folders"
CONFIG = "run/scan/sl-neus/first/config.yml"
MESH = "scan/ground_truth/mesh.ply"

SYNTH = ("sl-synth", "--frames", "2", "--resolution", "16", "--output")
CAPTURES = ("sl-synth", "--frames", "2", "--resolution", "16", "--images-only", "--output")
PATTERN = ("sl-pattern", "--width", "160", "--height", "160", "--period", "20", "--output")
GRAY = ("sl-pattern", "--kind", "gray-code", "--width", "64", "--height", "48", "--output")
PROCESS = ("sl-process", "--images", "captures/images", "--pattern", "captures/pattern.json",
           "--intrinsics", "captures/intrinsics.json", "--jobs", "1", "--output")  # fmt: skip
EXPORT = ("sl-export", "--load-config", CONFIG, "--resolution", "24", "--keep-unobserved", "--output")
EVAL = ("sl-eval", "--mesh", MESH, "--data", "scan", "--samples", "1000")
FIXTURES: dict[str, tuple[Fixture, ...]] = {
    "sl-process": ("captures",), "sl-export": ("scan", "run"), "sl-eval": ("scan",),
}  # fmt: skip

_COMMANDS = ("sl-check", "sl-eval", "sl-export", "sl-pattern", "sl-process", "sl-synth")
_WRONG_VALUES = (
    (SYNTH, "--frames", ("0", "1", "-3", "two", "1e400", "nan")), (SYNTH, "--resolution", ("0", "-1", "15", "big")),
    (SYNTH, "--scene", ("", "dragon", "missing.ply", "/proc/self/mem", "..")),
    (SYNTH, "--missing", ("-0.1", "1", "15", "nan", "inf")), (SYNTH, "--noise", ("-1", "nan", "inf")),
    (SYNTH, "--units", ("", "inch", "MM")), (EXPORT, "--resolution", ("-1", "0", "1", "many")),
    (PROCESS, "--jobs", ("-1", "many", "1.5", "0", "-99999999999", "9" * 5000)),
    (PROCESS, "--pattern", ("1024x768", "1x1", "0x0", "-5x5", "99999x99999", "1024x", "x768", "9" * 300 + "x768")),
    (PROCESS, "--cell", ("0", "-1", "2", "9" * 5000)), (PROCESS, "--sequence", ("opencv", "OpenCV", "", "x" * 10_000)),
)  # fmt: skip
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
    "dangling", "empty file", "empty", "captures/pattern.png", "captures/images", "captures/images/frame_00000.png",
    "text", "n" * 300, "captures/pattern.json/x", "x\udcff", "locked",
)  # fmt: skip
_FLAGS = ("--images", "--pattern", "--intrinsics", "--projector-intrinsics", "--masks", "--poses")

_FOLDERS: dict[str, tuple[str, ...]] = {
    "sl-synth": SYNTH, "sl-synth --images-only": CAPTURES, "sl-pattern": PATTERN, "sl-pattern gray-code": GRAY,
    "sl-process": PROCESS, "sl-process --work": (*PROCESS, "new", "--work"),
    "sl-export --poses": (*EXPORT, "new.ply", "--poses"),
}  # fmt: skip
_FILES: dict[str, tuple[tuple[str, ...], str]] = {
    "sl-export": (EXPORT, ".ply"),
    "sl-eval --json": ((*EVAL, "--json"), ".json"),
    "sl-eval --report": ((*EVAL, "--report"), ".html"),
}
_NOWHERE = (
    "/proc/x", "/proc/self/x", "/dev/null", "/dev/null/x", "/sys/kernel/x", "file", "file/x", "loop", "loop/x",
    "dangling", "dangling/x", "n" * 300, "x/" + "n" * 300, "d/" * 2100 + "x", "fifo", "fifo/x",
)  # fmt: skip
_TAKEN = ("full", "full/", ".", "..", "/", "")
_FINE = (
    "ä ö 日本", "a/b/c", "with space/and 'quote'", "trailing/", "empty", "link", "x\udcff", "new\nline", "$HOME", "*",
    "~", "n" * 255, "./dot/../new", "%s{x}[red]",
)  # fmt: skip


def cases() -> list[Case]:
    """All commands with each wrong flag, and each output in each wrong place."""
    return [*_flags(), *_outputs(), *_full_disks()]


def _flags() -> list[Case]:
    group, found = "Command lines", []
    for name in _COMMANDS:
        some = () if name == "sl-pattern" else ((),)
        for given in (*some, ("--no-such-flag", "1")):
            found.append(_nowhere(f"{name} {' '.join(given)}", (name, *given), group))
    for command, flag, values in _WRONG_VALUES:
        for value in values:
            found.append(_nowhere(f"{command[0]} {flag} {_short(value)}", _with(command, flag, value), group))
    group = "Flags of sl-process"
    for text in (*(f"baseline of frame 0 = {value} mm" for value in _VALUES), *_TEXTS):
        command = _with(PROCESS, "--known-length", text)
        found.append(_nowhere(f"--known-length {_short(text)}", command, group))
    for flag in _FLAGS:
        for path in _PATHS:
            if (flag, path) != ("--images", "captures/images"):
                found.append(_nowhere(f"{flag} {_short(path)}", _with(PROCESS, flag, path), group))
    return found


def _with(command: tuple[str, ...], flag: str, value: str) -> tuple[str, ...]:
    """The command into a new folder, with another value of a flag."""
    words = [*command, "new.ply" if command is EXPORT else "new"]
    if flag in words:
        place = words.index(flag)
        del words[place : place + 2]
    return (*words, f"{flag}={value}")


def _outputs() -> list[Case]:
    found = []
    for title, command in _FOLDERS.items():
        found += [_nowhere(f"{title} at {_short(place)}", (*command, place)) for place in _NOWHERE]
        if title not in ("sl-process --work", "sl-export --poses"):
            found += [_nowhere(f"{title} at {place!r}", (*command, place)) for place in _TAKEN]
        if title not in ("sl-process", "sl-process --work", "sl-export --poses", "sl-synth --images-only"):
            found += [_fine(f"{title} at {_short(place)}", (*command, place)) for place in _FINE]
    inner = [place for place in _NOWHERE if place.endswith("x")]
    for title, (command, ending) in _FILES.items():
        for place in (*inner, "loop", "fifo", "n" * 300, "d", "foreign"):
            found.append(_nowhere(f"{title} to {_short(place)}", (*command, place + ending)))
    found += [_fine("sl-process at ä ö", (*PROCESS, "ä ö/日本")), _fine("sl-export to ä ö", (*EXPORT, "ä ö/日本.ply"))]
    found += [
        _fine(f"sl-eval to {_short(p)}", (*EVAL, "--json", f"{p}/e.json")) for p in ("ä ö 日本", "x\udcff", "a\nb")
    ]
    found += [_nowhere(f"sl-eval {flags}", (*EVAL, *flags.split())) for flags in (
        "--json scan/transforms.json", "--json a.json --report a.json", f"--report {MESH}", "--json scan",
    )]  # fmt: skip
    for place in ("new", "new/work", "new/../new", "./new/x/..", "link/../new"):
        found.append(_nowhere(f"sl-process: new --work {place}", (*PROCESS, "new", "--work", place)))
    for place in ("new.ply", "new.ply/x", "scan", "scan/transforms.json"):
        found.append(_nowhere(f"sl-export: new.ply --poses {place}", (*EXPORT, "new.ply", "--poses", place)))
    return found


def _nowhere(title: str, command: tuple[str, ...], group: str = GROUP) -> Case:
    """A command that has to be refused, and must change nothing."""

    def attack(folder: Path) -> str:
        lay_places(folder)
        before = listing(folder)
        done = call(folder, *command)
        parsed = done.status == 2 and done.stderr.strip() and "Traceback" not in done.text  # refused by the parser
        return ("" if parsed else refused(done)) or left_behind(folder, before)

    return Case(group, title, FIXTURES.get(command[0], ()), attack)


def _fine(title: str, command: tuple[str, ...]) -> Case:
    def attack(folder: Path) -> str:
        lay_places(folder)
        before = listing(folder)
        done = call(folder, *command, seconds=300)
        return accepted(done) or ("" if listing(folder) > before else "wrote nothing where it should")

    return Case(GROUP, title, FIXTURES.get(command[0], ()), attack)


def _full_disks() -> list[Case]:
    """No file may grow beyond some thousand bytes."""
    commands = {
        "sl-synth": (*SYNTH, "new"), "sl-synth --images-only": (*CAPTURES, "new"), "sl-pattern": (*PATTERN, "new"),
        "sl-pattern gray-code": (*GRAY, "new"), "sl-export": (*EXPORT, "new.ply", "--poses", "poses"),
        "sl-eval": (*EVAL, "--json", "new.json", "--report", "new.html"),
    }  # fmt: skip

    def attack(folder: Path, command: tuple[str, ...], most: int) -> str:
        before = listing(folder)
        with files_of_at_most(most):
            done = call(folder, *command)
        if done.status == 0:
            return accepted(done) or ("" if listing(folder) > before else "wrote nothing")
        return refused(done, "cannot be written") or left_behind(folder, before)

    return [
        Case(GROUP, f"{title}, files of at most {most} bytes", FIXTURES.get(command[0], ()),
             partial(attack, command=command, most=most))
        for title, command in commands.items()
        for most in (1000, 2000, 4000, 10_000)
    ]  # fmt: skip


@contextmanager
def files_of_at_most(most: int) -> Iterator[None]:
    """Commands called in the block cannot write more bytes into a file, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def lay_places(folder: Path) -> None:
    """Files, links and folders that are not what belongs there, or with which outputs collide."""
    for name in ("file", "text", "locked", *(f"foreign{ending}" for ending in (".ply", ".json", ".html"))):
        (folder / name).write_text("mine")
    (folder / "empty file").write_bytes(b"")
    (folder / "locked").chmod(0)
    for ending in ("", ".ply", ".json", ".html"):
        (folder / f"loop{ending}").symlink_to(f"loop{ending}")
        os.mkfifo(folder / f"fifo{ending}")
        if ending:
            (folder / f"d{ending}").mkdir()
    (folder / "dangling").symlink_to("/nonexistent/x")
    for name in ("full", "empty", "target"):
        (folder / name).mkdir()
    (folder / "full" / "mine").write_text("mine")
    (folder / "link").symlink_to("target")


def _short(text: str) -> str:
    shown = repr(text)
    return shown if len(shown) < 60 else f"{shown[:40]}... of {len(text)} characters"
