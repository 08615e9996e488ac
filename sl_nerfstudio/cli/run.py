"""What commands share: how they end, without a traceback for what a user can correct, and loading a training run."""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import TextIOWrapper
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from sl_nerfstudio.errors import UserError

if TYPE_CHECKING:
    from sl_nerfstudio.parallel import DeviceName
    from sl_nerfstudio.runs.run import TrainedRun

EXIT_FAULT = 1
EXIT_INTERRUPTED = 130  # 128 + SIGINT, as shells expect
EXIT_TERMINATED = 143  # 128 + SIGTERM


class Terminated(KeyboardInterrupt):
    """SIGTERM arrived. All that cleans up after control-C does so now, too."""


def run(main: Callable[[], None]) -> None:
    """Call `main`; a `UserError` becomes `error: ...` on stderr and exit status 1, control-C status 130, SIGTERM 143.

    Anything else is a bug in this package and keeps its traceback.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # names of files may hold bytes that no encoding can show
    try:
        with sigterm_raised():
            main()
            sys.stdout.flush()
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(EXIT_FAULT)
    except KeyboardInterrupt as stop:
        _ignore_more_signals()
        terminated = isinstance(stop, Terminated)
        print("terminated" if terminated else "interrupted", file=sys.stderr)
        sys.exit(EXIT_TERMINATED if terminated else EXIT_INTERRUPTED)
    except BrokenPipeError:
        # The reader (`head`, a pager) has gone; what is still buffered must not raise again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(EXIT_FAULT)


@contextmanager
def sigterm_raised() -> Iterator[None]:
    """SIGTERM raises `Terminated` in the main thread, unless it is ignored or handled by somebody else already."""
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGTERM) != signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGTERM, _terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _terminate(number: int, frame: FrameType | None) -> None:
    raise Terminated


def _ignore_more_signals() -> None:
    """Keep a second control-C from printing a traceback while Python ends: everything is cleaned up."""
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)


def load_run(config: Path, data: Path | None, device: "DeviceName | None" = None) -> "TrainedRun":
    """`runs.run.load_run`; nerfstudio is imported for it without torch's compiler, which takes seconds."""
    from sl_nerfstudio.console import paragraph
    from sl_nerfstudio.late_imports import compiler_on_demand

    with compiler_on_demand():
        from sl_nerfstudio.runs import run as runs
    from sl_nerfstudio.parallel import usable_device

    where, sentence = usable_device(device)
    if sentence:
        print(paragraph("gpu", sentence), flush=True)
    return runs.load_run(config, data, where)
