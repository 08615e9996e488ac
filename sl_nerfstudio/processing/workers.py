"""Worker processes that end with their parent, whatever ends it, and leave control-C to it."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import connection, get_context, resource_tracker

from sl_nerfstudio.cores import cores

_EXIT_ORPHANED = 1
_PROCESS, _PIXEL = 1.4e9, 200  # bytes that decoding a photograph takes: of any size, and for each of its pixels
_MAIN_PROCESS = 1.0e9  # bytes of the process that collects the results, without the clouds that it may keep
_FOR_PROCESSES = 0.85  # share of the memory that is left to the processes


def default_processes(pixels: int, memory: int) -> int:
    """One for each core, but not more than `memory` (bytes) is enough for; `pixels` of the largest photograph."""
    room = _FOR_PROCESSES * memory - _MAIN_PROCESS
    return max(1, min(cores(), int(room / (_PROCESS + _PIXEL * pixels))))


@contextmanager
def worker_pool(workers: int, initialise: Callable[..., None], *arguments: object) -> Iterator[ProcessPoolExecutor]:
    """A pool of new processes, each of which calls `initialise` first; work must be submitted under `no_interrupts`.

    An exception in the block, control-C among them, ends the workers at once, whatever they are doing.
    """
    before = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(workers, get_context("spawn"), _start, (initialise, *arguments))
    try:
        yield pool
    except BaseException:
        for process in set(multiprocessing.active_children()) - before:
            process.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def no_interrupts() -> Iterator[None]:
    """Processes started in the block never see control-C: the terminal sends it to them, too, and each would print."""
    resource_tracker.ensure_running()  # when it starts by itself, it lets signals through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start(initialise: Callable[..., None], *arguments: object) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    initialise(*arguments)


def _end_with_parent() -> None:
    """Wait for the end of the parent: the pipe to it, which only it holds, is then closed by the kernel."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(_EXIT_ORPHANED)
