"""Functions that run in a process of their own, a fork of one that has no threads.

A fork of the process of the tests would have the locks of its other threads (torch, OpenCV, open3d), which nobody
frees: now and then, it would wait for ever.
"""

import multiprocessing
import os
import signal
import warnings
from collections.abc import Callable
from multiprocessing.context import ForkServerProcess
from typing import Any

import pytest

from benchmarks.attacks.dying import die_at_change
from sl_nerfstudio.parallel import only_one_library_thread

LONGEST = 300.0  # seconds
_FORKS = multiprocessing.get_context("forkserver")
_FORKS.set_forkserver_preload(["sl_nerfstudio.methods", "sl_nerfstudio.cli.process", __name__])


def fork(work: Callable[..., object], *arguments: Any) -> ForkServerProcess:
    """Start some work, in silence; its function and arguments can be pickled."""
    process = _FORKS.Process(target=_begin, args=(dict(os.environ), work, arguments))
    process.start()
    return process


def _begin(environment: dict[str, str], work: Callable[..., object], arguments: tuple[Any, ...]) -> None:
    os.environ.clear()
    os.environ.update(environment)  # of now: the server has that of its start
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    warnings.simplefilter("ignore")
    only_one_library_thread()
    work(*arguments)


def exit_status(process: ForkServerProcess) -> int:
    """Wait for the end; -N if it was ended by signal N. What does not end is killed, and the test fails."""
    process.join(LONGEST)
    status = process.exitcode
    if status is None:
        process.kill()
        pytest.fail(f"{process.name} has not ended after {LONGEST:.0f} s")
    return status


def killed_at_change(moment: int, work: Callable[..., object], *arguments: Any) -> bool:
    """Do some work that is killed just before its change number `moment` of the disk; whether it came to that."""
    status = exit_status(fork(_dying, moment, work, arguments))
    assert status in (0, -signal.SIGKILL)
    return status != 0


def _dying(moment: int, work: Callable[..., object], arguments: tuple[Any, ...]) -> None:
    die_at_change(moment)
    work(*arguments)
