"""Places where nothing can be written, or where something lies already; full disks; odd names."""

import os
import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from benchmarks.attacks.case import Case, Fixture
from benchmarks.attacks.commands import Done, call
from benchmarks.attacks.expect import accepted, refused

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
    """Every command with each place."""
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
    return [*found, *_full_disks(), *_overlaps(), *_stale_locks()]


def _overlaps() -> list[Case]:
    """Outputs in each other's way."""
    work = [
        (*PROCESS, "new", "--work", place) for place in ("new", "new/work", "new/../new", "./new/x/..", "link/../new")
    ]
    poses = [
        (*EXPORT, "new.ply", "--poses", place) for place in ("new.ply", "new.ply/x", "scan", "scan/transforms.json")
    ]
    return [_nowhere(f"{line[0]}: {' '.join(line[-3:])}", line) for line in (*work, *poses)]


def _full_disks() -> list[Case]:
    """No file may grow beyond some thousand bytes."""
    commands = {
        "sl-synth": (*SYNTH, "new"), "sl-synth --images-only": (*CAPTURES, "new"), "sl-pattern": (*PATTERN, "new"),
        "sl-pattern gray-code": (*GRAY, "new"), "sl-export": (*EXPORT, "new.ply", "--poses", "poses"),
        "sl-eval": (*EVAL, "--json", "new.json", "--report", "new.html"),
    }  # fmt: skip
    return [
        Case(GROUP, f"{title}, files of at most {most} bytes", FIXTURES.get(command[0], ()), _full_disk(command, most))
        for title, command in commands.items()
        for most in (1000, 2000, 4000, 10_000)
    ]


def _full_disk(command: tuple[str, ...], most: int) -> Callable[[Path], str]:
    def attack(folder: Path) -> str:
        before = listing(folder)
        with files_of_at_most(most):
            done = call(folder, *command)
        if done.status == 0:
            return accepted(done) or ("" if listing(folder) > before else "wrote nothing")
        return refused(done, "cannot be written") or left_behind(folder, before)

    return attack


def _stale_locks() -> list[Case]:
    """Files that look like those of a killed process."""
    notes = {
        "empty": b"", "of nobody": b"{}\n", "text": b"mine", "deeply nested": b"[" * 100_000,
        "with a list that leads away": b'{"sl-nerfstudio": {"command": "x", "process": 1, "host": "h", "since": "s"}}\n'
        b'"../precious"\n"/etc/hostname"\n',
    }  # fmt: skip
    found = []
    for title, note in notes.items():
        for name, command in (("sl-synth", SYNTH), ("sl-pattern", PATTERN)):
            found.append(Case(GROUP, f"{name} into a folder with a lock {title}", (), _stale_lock(command, note)))
    return found


def _stale_lock(command: tuple[str, ...], note: bytes) -> Callable[[Path], str]:
    def attack(folder: Path) -> str:
        (folder / "precious").write_text("precious")
        (folder / "new").mkdir()
        (folder / "new" / ".sl-lock").write_bytes(note)
        done = call(folder, *command, "new")
        if (folder / "precious").read_text() != "precious":
            return "a file outside was changed"
        return accepted(done) if done.status == 0 else refused(done, "remedy")

    return attack


def lay_places(folder: Path) -> None:
    """Files, links and folders with which outputs collide."""
    (folder / "file").write_text("mine")
    for ending in (".ply", ".json", ".html"):
        (folder / f"foreign{ending}").write_text("mine")
        (folder / f"d{ending}").mkdir()
        (folder / f"loop{ending}").symlink_to(f"loop{ending}")
        os.mkfifo(folder / f"fifo{ending}")
    (folder / "loop").symlink_to("loop")
    (folder / "dangling").symlink_to("/nonexistent/x")
    os.mkfifo(folder / "fifo")
    (folder / "full").mkdir()
    (folder / "full" / "mine").write_text("mine")
    (folder / "empty").mkdir()
    (folder / "target").mkdir()
    (folder / "link").symlink_to("target")


def _nowhere(title: str, command: tuple[str, ...]) -> Case:
    def attack(folder: Path) -> str:
        lay_places(folder)
        before = listing(folder)
        return _refused_or_parsed(call(folder, *command)) or left_behind(folder, before)

    return Case(GROUP, title, FIXTURES.get(command[0], ()), attack)


def _fine(title: str, command: tuple[str, ...]) -> Case:
    def attack(folder: Path) -> str:
        lay_places(folder)
        before = listing(folder)
        done = call(folder, *command, seconds=300)
        return accepted(done) or ("" if listing(folder) > before else "wrote nothing where it should")

    return Case(GROUP, title, FIXTURES.get(command[0], ()), attack)


def _refused_or_parsed(done: Done) -> str:
    """An empty path is none for the parser of flags, which ends with status 2."""
    return "" if done.status == 2 and done.stderr.strip() else refused(done)


def listing(folder: Path) -> set[str]:
    """All files and folders, without what the command printed."""
    return {str(p.relative_to(folder)) for p in folder.rglob("*") if not p.name.startswith(".std")}


def left_behind(folder: Path, before: set[str]) -> str:
    """The fault if a command that was refused changed the folder."""
    left = sorted(listing(folder) ^ before)
    return f"left or removed {left[0]!r}" if left else ""


@contextmanager
def files_of_at_most(most: int) -> Iterator[None]:
    """Commands called in the block cannot write more bytes into a file, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def _short(place: str) -> str:
    text = repr(place)
    return text if len(text) < 40 else f"{text[:20]}... of {len(place)} characters"
