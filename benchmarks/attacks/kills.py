"""Commands that are killed or stopped, and two at once: the next one must refuse or succeed with the right result."""

import random
import signal
from collections.abc import Callable
from pathlib import Path

from benchmarks.attacks.case import Case
from benchmarks.attacks.commands import call, start
from benchmarks.attacks.dying import dying
from benchmarks.attacks.expect import accepted, refused
from benchmarks.attacks.output_folders import (
    CAPTURES,
    EVAL,
    EXPORT,
    FIXTURES,
    GRAY,
    PATTERN,
    SYNTH,
    left_behind,
    listing,
)  # fmt: skip
from sl_nerfstudio.storage import locked, locked_file

GROUP, TWO = "Killed commands", "Two commands at once"

# Command, its outputs, and about how often it changes the disk.
_COMMANDS: dict[str, tuple[tuple[str, ...], tuple[str, ...], int]] = {
    "sl-pattern": ((*PATTERN, "new"), ("new",), 12),
    "sl-pattern gray-code": ((*GRAY, "new"), ("new",), 110),
    "sl-synth": ((*SYNTH, "new"), ("new",), 90),
    "sl-synth --images-only": ((*CAPTURES, "new"), ("new",), 90),
    "sl-export": ((*EXPORT, "new.ply", "--poses", "poses", "--overwrite"), ("new.ply", "poses/transforms.json"), 18),
    "sl-eval": ((*EVAL, "--json", "new.json", "--report", "new.html"), ("new.json",), 12),
}
_MOMENTS = 9  # of each command and each signal
_STATUS = {signal.SIGINT: 130, signal.SIGTERM: 143}


def cases() -> list[Case]:
    """Every command killed, terminated and interrupted at seeded moments, and twice at once."""
    found = []
    for title, (command, outputs, changes) in _COMMANDS.items():
        rng = random.Random(title)
        moments = sorted({0, changes, *(rng.randrange(1, changes) for _ in range(_MOMENTS - 2))})
        fixtures = FIXTURES.get(command[0], ())
        for moment in moments:
            name = f"{title} killed at change {moment} of the disk"
            found.append(Case(GROUP, name, fixtures, _killed(command, outputs, moment)))
        for number in (signal.SIGINT, signal.SIGTERM):
            for moment in moments[::3]:
                name = f"{title}, {number.name} at change {moment} of the disk"
                found.append(Case(GROUP, name, fixtures, _stopped(command, moment, number)))
        found.append(Case(TWO, f"{title}, output held by another process", fixtures, _held(command)))
        if command[0] in ("sl-synth", "sl-pattern"):
            found.append(Case(TWO, f"{title}, three started at the same time", fixtures, _at_once(command)))
    return found


def _killed(command: tuple[str, ...], outputs: tuple[str, ...], moment: int) -> Callable[[Path], str]:
    def attack(folder: Path) -> str:
        before = listing(folder)
        with dying(moment):
            first = call(folder, *command)
        if first.status not in (0, -signal.SIGKILL):
            return f"the killed command ended with status {first.status}"
        again = call(folder, *command)
        if first.status == 0 and again.status == 1:
            return refused(again, "is not empty")
        fault = accepted(again)
        hidden = sorted(path for path in listing(folder) - before if Path(path).name.startswith("."))
        return fault or (f"left {hidden[0]}" if hidden else "") or _differs(folder, command, outputs)

    return attack


def _differs(folder: Path, command: tuple[str, ...], outputs: tuple[str, ...]) -> str:
    """The fault if the outputs are not those of a command that nothing stopped."""
    found = {name: contents(folder / name) for name in outputs}
    for name in outputs:
        path = folder / name
        path.rename(path.with_name("killed " + path.name))
    fault = accepted(call(folder, *command))
    if fault:
        return f"the uninterrupted command failed: {fault}"
    wrong = [name for name in outputs if contents(folder / name) != found[name]]
    return f"{wrong[0]} differs from that of an uninterrupted command" if wrong else ""


def _stopped(command: tuple[str, ...], moment: int, number: signal.Signals) -> Callable[[Path], str]:
    def attack(folder: Path) -> str:
        before = listing(folder)
        with dying(moment, number):
            done = call(folder, *command)
        if done.status == 0:
            return accepted(done)
        if done.status != _STATUS[number]:
            return f"exit status {done.status} after {number.name}"
        said = "terminated\n" if number == signal.SIGTERM else "interrupted\n"
        if done.stderr != said:
            return f"said {done.stderr[:100]!r}"
        whole = command[0] in ("sl-synth", "sl-pattern")  # of several files, those that are complete stay
        left = {name for name in listing(folder) - before if whole or Path(name).name.startswith(".")}
        return f"left {sorted(left)[0]!r}" if left else ""

    return attack


def _held(command: tuple[str, ...]) -> Callable[[Path], str]:
    def attack(folder: Path) -> str:
        outputs = [folder / word for word in command if word.startswith("new")]
        with (locked if outputs[0].suffix == "" else locked_file)(outputs[0]):
            before = listing(folder)
            done = call(folder, *command)
            fault = refused(done, "is in use by", "process", "remedy") or left_behind(folder, before)
        return fault or accepted(call(folder, *command))

    return attack


def _at_once(command: tuple[str, ...]) -> Callable[[Path], str]:
    def attack(folder: Path) -> str:
        processes = [start(folder, *command) for _ in range(3)]
        texts = [process.communicate()[1] for process in processes]
        good = [process.returncode for process in processes].count(0)
        if good != 1:
            return f"{good} of 3 succeeded: {texts[0][:100]!r}"
        for process, text in zip(processes, texts, strict=True):
            if process.returncode and not ("is in use by" in text or "is not empty" in text):
                return f"a second one said {text[:100]!r}"
        return _differs(folder, command, ("new",))

    return attack


def contents(path: Path) -> dict[str, bytes]:
    """A file, or all files below a folder."""
    files = [path] if path.is_file() else path.rglob("*")
    return {str(file.relative_to(path)): file.read_bytes() for file in files if file.is_file()}
