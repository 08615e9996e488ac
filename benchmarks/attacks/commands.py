"""Run the real commands: in a copy of a process that has imported everything, or as a process of their own."""

import importlib
import os
import resource
import signal
import subprocess
import sys
import time
import traceback
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import NoReturn

TIMEOUT = -1000
"""Status of a command that had to be stopped because it did not end."""

_OUT, _ERR = ".stdout", ".stderr"
_PRELOADED = ("sl-check", "sl-eval", "sl-export", "sl-pattern", "sl-process", "sl-synth", "ns-train")


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


def call(folder: Path, name: str, *arguments: str, seconds: float = 60.0) -> Done:
    """Run a console command in `folder`, in a fork of this process: it need not import everything again.

    A command that has not ended after `seconds` is killed, with all processes that it started.
    """
    begin = time.monotonic()
    child = os.fork()
    if child == 0:
        _run_here(folder, name, arguments)
    status, usage = _wait(child, begin + seconds)
    return Done(status, _text(folder / _OUT), _text(folder / _ERR), time.monotonic() - begin, usage)


def start(folder: Path, name: str, *arguments: str) -> "subprocess.Popen[str]":
    """Start a console command as a process group of its own, with pipes for what it prints."""
    module, function = _entry_point(name)
    code = f"import sys; sys.argv[0] = {name!r}; from {module} import {function} as main; sys.exit(main())"
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        stdin=subprocess.DEVNULL,
        text=True,
        errors="replace",
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        start_new_session=True,
    )


def preload() -> None:
    """Import the commands and what they import late, so that forks need not."""
    import torch

    torch.set_num_threads(1)
    for name in _PRELOADED:
        importlib.import_module(_entry_point(name)[0])
    import open3d  # noqa: F401
    import scipy.ndimage  # noqa: F401
    import skimage.measure  # noqa: F401
    import trimesh  # noqa: F401

    import sl_nerfstudio.methods
    import sl_nerfstudio.runs.export  # noqa: F401


def _text(path: Path) -> str:
    return path.read_text(errors="replace") if path.exists() else ""


@cache
def _entry_point(name: str) -> tuple[str, str]:
    (found,) = entry_points(group="console_scripts", name=name)
    module, function = found.value.split(":")
    return module, function


def _run_here(folder: Path, name: str, arguments: tuple[str, ...]) -> NoReturn:
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
        status = _status_of(getattr(importlib.import_module(module), function))
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
