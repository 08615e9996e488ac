"""Commands that are killed or stopped, and two at once: the next one must refuse or succeed with the right result."""

import hashlib
import random
import shutil
import signal
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import sl_nerfstudio
from benchmarks.attacks.commands import Case, accepted, call, contents, left_behind, listing, refused, start
from benchmarks.attacks.dying import die_at_change
from benchmarks.attacks.flags import CAPTURES, EVAL, EXPORT, FIXTURES, GRAY, PATTERN, PROCESS, SYNTH
from sl_nerfstudio.storage import locked, locked_file

GROUP, TWO, LONG = "Killed commands", "Two commands at once", "Killed sl-process"

# Command, its outputs, and about how often it changes the disk.
_COMMANDS: dict[str, tuple[tuple[str, ...], tuple[str, ...], int]] = {
    "sl-pattern": ((*PATTERN, "new"), ("new",), 12), "sl-pattern gray-code": ((*GRAY, "new"), ("new",), 110),
    "sl-synth": ((*SYNTH, "new"), ("new",), 90), "sl-synth --images-only": ((*CAPTURES, "new"), ("new",), 90),
    "sl-export": ((*EXPORT, "new.ply", "--poses", "poses", "--overwrite"), ("new.ply", "poses/transforms.json"), 18),
    "sl-eval": ((*EVAL, "--json", "new.json", "--report", "new.html"), ("new.json",), 12),
}  # fmt: skip
_MOMENTS = 9  # of each command and each signal
_STATUS = {signal.SIGINT: (130, "interrupted\n"), signal.SIGTERM: (143, "terminated\n")}
_PROCESS = (*PROCESS, "new", "--work", "work")
_SECONDS = 600.0


def cases() -> list[Case]:
    """Every command killed, terminated and interrupted at seeded moments, and twice at once."""
    found = []
    for title, (command, outputs, changes) in _COMMANDS.items():
        rng, fixtures = random.Random(title), FIXTURES.get(command[0], ())

        def add(group: str, name: str, attack: Callable[[Path], str], title: str = title, fixtures=fixtures) -> None:
            found.append(Case(group, f"{title}{name}", fixtures, attack))

        moments = sorted({0, changes, *(rng.randrange(1, changes) for _ in range(_MOMENTS - 2))})
        for moment in moments:
            attack = partial(_killed, command=command, outputs=outputs, moment=moment)
            add(GROUP, f" killed at change {moment} of the disk", attack)
        for number in _STATUS:
            for moment in moments[::3]:
                attack = partial(_stopped, command=command, moment=moment, number=number)
                add(GROUP, f", {number.name} at change {moment} of the disk", attack)
        add(TWO, ", output held by another process", partial(_held, command=command))
        if command[0] in ("sl-synth", "sl-pattern"):
            add(TWO, ", three started at the same time", partial(_at_once, command=command))
    rng = random.Random(LONG)
    for stage, count, changes in (("decoding", 3, 40), ("registration", 6, 30), ("writing", 8, 90)):
        for moment in sorted(rng.sample(range(3, changes), count)):
            attack = partial(_killed_process, stage=stage, moment=moment)
            found.append(Case(LONG, f"{stage}: SIGKILL at change {moment} of the disk", ("captures",), attack))
    return [*found, Case(LONG, "one process and four give the same bytes", ("captures",), _jobs)]


def _killed(folder: Path, command: tuple[str, ...], outputs: tuple[str, ...], moment: int) -> str:
    before = listing(folder)
    first = call(folder, *command, first=partial(die_at_change, moment))
    if first.status not in (0, -signal.SIGKILL):
        return f"the killed command ended with status {first.status}"
    again = call(folder, *command)
    if first.status == 0 and again.status == 1:
        return refused(again, "is not empty")
    fault = accepted(again)
    hidden = sorted(path for path in listing(folder) - before if Path(path).name.startswith("."))
    return fault or (f"left {hidden[0]}" if hidden else "") or _differs(folder, command, outputs)


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


def _stopped(folder: Path, command: tuple[str, ...], moment: int, number: signal.Signals) -> str:
    before = listing(folder)
    done = call(folder, *command, first=partial(die_at_change, moment, number))
    if done.status == 0:
        return accepted(done)
    if (done.status, done.stderr) != _STATUS[number]:
        return f"exit status {done.status} after {number.name}, said {done.stderr[:100]!r}"
    whole = command[0] in ("sl-synth", "sl-pattern")  # of several files, those that are complete stay
    left = {name for name in listing(folder) - before if whole or Path(name).name.startswith(".")}
    return f"left {sorted(left)[0]!r}" if left else ""


def _held(folder: Path, command: tuple[str, ...]) -> str:
    outputs = [folder / word for word in command if word.startswith("new")]
    with (locked if outputs[0].suffix == "" else locked_file)(outputs[0]):
        before = listing(folder)
        done = call(folder, *command)
        fault = refused(done, "is in use by", "process", "remedy") or left_behind(folder, before)
    return fault or accepted(call(folder, *command))


def _at_once(folder: Path, command: tuple[str, ...]) -> str:
    processes = [start(folder, *command) for _ in range(3)]
    texts = [process.communicate()[1] for process in processes]
    good = [process.returncode for process in processes].count(0)
    if good != 1:
        return f"{good} of 3 succeeded: {texts[0][:100]!r}"
    for process, text in zip(processes, texts, strict=True):
        if process.returncode and not ("is in use by" in text or "is not empty" in text):
            return f"a second one said {text[:100]!r}"
    return _differs(folder, command, ("new",))


def _code() -> str:
    """Digest of the sources of the package: a run by other code is no reference."""
    sources = sorted(Path(sl_nerfstudio.__file__).parent.rglob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:12]


def prepared(folder: Path) -> Path:
    """Scan and work folder of a run that nothing stopped, made once by the same code beside the fixtures."""
    root = folder.parents[1] / "fixtures" / f"processed-{_code()}"
    while not (root / "complete").exists():
        try:
            with locked(root):
                if not (root / "complete").exists():
                    _prepare(folder, root)
        except Exception as error:
            if "is in use" not in str(error):
                raise
            time.sleep(1)
    return root


def _prepare(folder: Path, root: Path) -> None:
    fault = accepted(call(folder, *_PROCESS, seconds=_SECONDS))
    if fault:
        raise RuntimeError(f"the uninterrupted run failed: {fault}")
    for old, new in (("new", "scan"), ("work", "work")):
        shutil.rmtree(root / new, ignore_errors=True)
        shutil.move(folder / old, root / new)
    (root / "complete").touch()


def _killed_process(folder: Path, stage: str, moment: int) -> str:
    """The next run ends with the scan of an uninterrupted one, and leaves nothing hidden."""
    work, scan = prepared(folder) / "work", contents(prepared(folder) / "scan")
    if stage != "decoding":
        shutil.copytree(work, folder / "work")
    if stage == "registration":
        for path in (folder / "work" / "stages").iterdir():
            if not path.name.startswith("calibration"):
                path.unlink()
    done = call(folder, *_PROCESS, seconds=_SECONDS, first=partial(die_at_change, moment))
    if done.status == 0:
        return "" if contents(folder / "new") == scan else "another scan"
    if done.status != -signal.SIGKILL:
        return f"the killed command ended with status {done.status}"
    fault = accepted(call(folder, *_PROCESS, seconds=_SECONDS))
    if fault:
        return fault
    if contents(folder / "new") != scan:
        return "the scan differs from that of an uninterrupted run"
    hidden = [path for name in ("new", "work") for path in (folder / name).rglob(".*")]
    return f"left {hidden[0].name}" if hidden else ""


def _jobs(folder: Path) -> str:
    one = prepared(folder) / "scan"
    done = call(folder, *("4" if word == "1" else word for word in _PROCESS), seconds=_SECONDS)
    return accepted(done) or ("" if contents(folder / "new") == contents(one) else "another scan than with --jobs 1")
