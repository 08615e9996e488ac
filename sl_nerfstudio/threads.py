"""Independent pieces of work in parallel, on as many threads as torch uses.

The pieces are numba kernels that release the GIL. Idle threads sleep: unlike an OpenMP team they do not spin beside
torch's own. Callers may be several threads (training, viewer) at once.
"""

import itertools
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache, partial
from typing import TypeVar

import torch
from threadpoolctl import threadpool_limits

from sl_nerfstudio.cores import cores
from sl_nerfstudio.memory import keep_freed_memory

T = TypeVar("T")

if torch.get_num_threads() > cores():  # torch does not know of quotas
    torch.set_num_threads(cores())
keep_freed_memory()

_ours: int | None = None  # threads of our own loops while torch has one
_this_thread = threading.local()  # `one_of_many`: it works on one of as many tasks as there are threads, or more


def threads() -> int:
    """Number of threads that take part; one in a task of `parallel` whose other threads are busy with other tasks."""
    if getattr(_this_thread, "one_of_many", False):
        return 1
    return torch.get_num_threads() if _ours is None else _ours


@contextmanager
def one_library_thread() -> Iterator[None]:
    """Operations of torch and of numpy's BLAS on one thread, our loops on all, for work made of many small operations.

    Those gain nothing from a team of threads, which spin between them: beside other busy processes the work then takes
    ten times as long and more.
    """
    with one_torch_thread(), threadpool_limits(limits=1, user_api="blas"):
        yield


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """The same without BLAS, for what is called often: looking for the process's BLAS libraries takes milliseconds."""
    global _ours
    before, count = _ours, torch.get_num_threads()
    _ours = threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(count)
        _ours = before


def torch_on_one_thread() -> None:
    """`one_torch_thread` for the rest of this process."""
    global _ours
    _ours = threads()
    torch.set_num_threads(1)


def only_one_library_thread() -> None:
    """All libraries and our loops on one thread for the rest of this process: one of several that share the cores."""
    torch.set_num_threads(1)
    threadpool_limits(limits=1, user_api="blas")


@lru_cache(maxsize=1)
def _pool(process: int) -> ThreadPoolExecutor:
    """The process's threads; a forked child makes its own."""
    return ThreadPoolExecutor(max_workers=max((os.cpu_count() or 2) - 1, 1), thread_name_prefix="sl-threads")


def parallel(tasks: Sequence[Callable[[], object]]) -> None:
    """Run all tasks, each once, in any order, on up to `threads()` threads; raises what a task raises.

    Tasks may themselves call this: a thread that has not begun when the tasks are done is not waited for. Where there
    are enough tasks for all threads, what they call stays on their own thread.
    """
    queue, count = itertools.count(), threads()
    others, many = min(count, len(tasks)) - 1, len(tasks) >= count > 1
    futures = [_pool(os.getpid()).submit(_work, tasks, queue, many) for _ in range(others)]
    try:
        _work(tasks, queue, many)
    finally:
        errors = [future.exception() for future in futures if not future.cancel()]
    for error in errors:
        if error is not None:
            raise error


def results(tasks: Sequence[Callable[[], T]]) -> list[T]:
    """What the tasks return, in their order; they run as in `parallel`, and gain where they leave Python's lock free.

    numpy, torch and open3d do so while they work on large arrays.
    """
    found: dict[int, T] = {}
    parallel([partial(_keep, found, k, task) for k, task in enumerate(tasks)])
    return [found[k] for k in range(len(tasks))]


def _keep(found: dict[int, T], k: int, task: Callable[[], T]) -> None:
    found[k] = task()


def _work(tasks: Sequence[Callable[[], object]], queue: Iterator[int], many: bool) -> None:
    """Run tasks until none is left; `queue` gives each number once, whichever thread asks."""
    before = getattr(_this_thread, "one_of_many", False)
    _this_thread.one_of_many = before or many
    try:
        while (i := next(queue)) < len(tasks):
            tasks[i]()
    finally:
        _this_thread.one_of_many = before


def split(n: int, parts: int, multiple: int) -> list[tuple[int, int]]:
    """One to `parts` ranges that cover 0..n, with boundaries at multiples of `multiple`."""
    step = max(-(-n // parts), 1)
    step = -(-step // multiple) * multiple
    return [(start, min(start + step, n)) for start in range(0, max(n, 1), step)]
