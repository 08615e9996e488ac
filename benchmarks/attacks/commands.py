"""What an attack is, how the real commands are run, and what they should have done."""

import importlib
import os
import resource
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Literal, NoReturn

TIMEOUT = -1000  # status of a command that had to be stopped because it did not end
Fixture = Literal["scan", "captures", "pattern", "run"]
_MOST_LINES = 60  # a longer message is not read
_MOST_GB = 3.0  # small input must not fill the memory

_OUT, _ERR = ".stdout", ".stderr"
_PRELOADED = ("sl-check", "sl-eval", "sl-export", "sl-pattern", "sl-process", "sl-synth", "ns-train")


@dataclass(frozen=True)
class Case:
    """One attack on one command, or on a row of them."""

    group: str  # heading in the table
    name: str  # unique in the group
    fixtures: tuple[Fixture, ...]  # fresh copies of these lie in the case's folder, under their names
    attack: Callable[[Path], str]  # called with that folder; "" if the package did right, else what it did wrong


@dataclass(frozen=True)
class Done:
    """How a command ended."""

    status: int  # exit status; minus the signal that killed it; TIMEOUT
    stdout: str
    stderr: str
    seconds: float = 0.0
    peak_gb: float = 0.0

    @property
    def text(self) -> str:
        """All that it printed."""
        return self.stdout + self.stderr


def refused(done: Done, *words: str) -> str:
    """The fault, or "" if the command ended with status 1 and a message, not too long, that holds all words."""
    fault = _crashed(done)
    if fault:
        return fault
    if done.status != 1:
        return f"exit status {done.status}"
    if not done.text.strip():
        return "no message"
    if len(done.text.splitlines()) > _MOST_LINES:
        return f"a message of {len(done.text.splitlines())} lines"
    return _missing(done, words)


def accepted(done: Done, *words: str) -> str:
    """The fault, or "" if the command ended with status 0 and printed all words."""
    return _crashed(done) or (f"exit status {done.status}" if done.status else _missing(done, words))


def _missing(done: Done, words: tuple[str, ...]) -> str:
    missing = [word for word in words if word.lower() not in done.text.lower()]
    said = (done.stderr.strip() or done.stdout.strip() or "(nothing)").splitlines()[0][:150]
    return f"does not say {missing[0]!r}: {said}" if missing else ""


def _crashed(done: Done) -> str:
    """What no input may cause."""
    if done.status == TIMEOUT:
        return f"did not end within {done.seconds:.0f} s"
    if done.status < 0:
        return f"killed by signal {-done.status}"
    if "Traceback (most recent call last)" in done.text:
        return f"traceback: {done.text.strip().splitlines()[-1][:150]}"
    return f"took {done.peak_gb:.1f} GB of memory" if done.peak_gb > _MOST_GB else ""


def listing(folder: Path) -> set[str]:
    """All files and folders, without what the command printed."""
    return {str(p.relative_to(folder)) for p in folder.rglob("*") if not p.name.startswith(".std")}


def left_behind(folder: Path, before: set[str]) -> str:
    """The fault if a command that was refused changed the folder."""
    left = sorted(listing(folder) ^ before)
    return f"left or removed {left[0]!r}" if left else ""


def contents(path: Path) -> dict[str, bytes]:
    """A file, or all files below a folder."""
    files = [path] if path.is_file() else path.rglob("*")
    return {str(file.relative_to(path)): file.read_bytes() for file in files if file.is_file()}


def call(
    folder: Path, name: str, *arguments: str, seconds: float = 60.0, first: Callable[[], None] = lambda: None
) -> Done:
    """Run a console command in `folder`, in a fork of this process: it need not import everything again.

    The fork calls `first` before the command.
    A command that has not ended after `seconds` is killed, with all processes that it started.
    """
    begin = time.monotonic()
    child = os.fork()
    if child == 0:
        _run_here(folder, name, arguments, first)
    status, usage = _wait(child, begin + seconds)
    out, err = (p.read_text(errors="replace") if p.exists() else "" for p in (folder / _OUT, folder / _ERR))
    return Done(status, out, err, time.monotonic() - begin, usage)


def start(folder: Path, name: str, *arguments: str) -> "subprocess.Popen[str]":
    """Start a console command as a process group of its own, with pipes for what it prints."""
    module, function = _entry_point(name)
    code = f"import sys; sys.argv[0] = {name!r}; from {module} import {function} as main; sys.exit(main())"
    pipes: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments], cwd=folder, **pipes, text=True, errors="replace", env=environment,
        start_new_session=True,
    )  # fmt: skip


def preload() -> None:
    """Import the commands and what they import late, so that forks need not."""
    import torch

    torch.set_num_threads(1)
    for name in _PRELOADED:
        importlib.import_module(_entry_point(name)[0])
    for name in ("open3d", "scipy.ndimage", "skimage.measure", "trimesh", "sl_nerfstudio.methods"):
        importlib.import_module(name)


@cache
def _entry_point(name: str) -> tuple[str, str]:
    (found,) = entry_points(group="console_scripts", name=name)
    module, function = found.value.split(":")
    return module, function


def _run_here(folder: Path, name: str, arguments: tuple[str, ...], first: Callable[[], None]) -> NoReturn:
    """The rest of a forked process: the command, with its output in files."""
    status = 70
    try:
        os.setsid()
        os.chdir(folder)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        for number, part in ((1, _OUT), (2, _ERR)):
            file = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(file, number)
        null = os.open(os.devnull, os.O_RDONLY)
        os.dup2(null, 0)
        sys.stdin, sys.stdout, sys.stderr = os.fdopen(0), os.fdopen(1, "w"), os.fdopen(2, "w")
        sys.argv = [name, *arguments]
        module, function = _entry_point(name)
        main = getattr(importlib.import_module(module), function)
        first()
        status = _status_of(main)
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(status)


def _status_of(main: object) -> int:
    """What the shell would see."""
    assert callable(main)
    try:
        main()
    except SystemExit as error:
        if isinstance(error.code, str):
            print(error.code, file=sys.stderr)
            return 1
        return int(error.code or 0)
    except BaseException:
        traceback.print_exc()
        return 1
    return 0


def _wait(child: int, end: float) -> tuple[int, float]:
    """Status and peak memory of the child; it is killed at the time `end`."""
    pause, stopped = 0.002, False
    while True:
        pid, status, usage = os.wait4(child, os.WNOHANG)
        if pid:
            code = -os.WTERMSIG(status) if os.WIFSIGNALED(status) else os.WEXITSTATUS(status)
            return TIMEOUT if stopped else code, usage.ru_maxrss / 2**20
        if time.monotonic() > end and not stopped:
            stopped = True
            for kill in (os.killpg, os.kill):  # the group exists only after setsid
                with suppress(ProcessLookupError):
                    kill(child, signal.SIGKILL)
        time.sleep(pause)
        pause = min(2 * pause, 0.05)
