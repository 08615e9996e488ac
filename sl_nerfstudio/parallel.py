"""What this process may use of the machine, its GPU too, and work on many pieces side by side on all threads."""

import ctypes
import fcntl
import inspect
import itertools
import math
import mmap
import multiprocessing
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import cache, lru_cache, partial
from itertools import product
from multiprocessing import connection, resource_tracker
from pathlib import Path
from typing import Any, Literal, TypeVar

import numba
import torch
from threadpoolctl import threadpool_limits

from sl_nerfstudio.console import track
from sl_nerfstudio.errors import UserError, first_line

# What this process may use: as its affinity mask and its control groups (cgroups(7)) allow. joblib counts cores by the
# outermost group alone, and knows nothing of the limit of the memory.

ROOT, OWN = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


def cores() -> int:
    """Number of cores, at least 1. A container that is given two of 64 cores by a quota still sees 64."""
    mask = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quotas = [math.inf]
    for stated in _group_limits("cpu", ("cpu.max",), ("cpu.cfs_quota_us", "cpu.cfs_period_us")):
        with suppress(ValueError, ZeroDivisionError):  # "max"
            allowed, period = map(float, stated)
            quotas += [allowed / period] if allowed > 0 else []
    return max(math.ceil(min(mask, *quotas)), 1)


def memory_of_process() -> int:
    """Bytes of memory: the machine's, or fewer."""
    limits = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    for stated in _group_limits("memory", ("memory.max",), ("memory.limit_in_bytes",)):
        with suppress(ValueError):
            limits += map(int, stated)
    return min(limits)


def _group_limits(controller: str, *files: tuple[str, ...]) -> Iterator[list[str]]:
    """Words in files of the groups whose limits hold for this process: its own (version 2 and 1) and all around them.

    A container sees its own group as the root.
    """
    lines = OWN.read_text().splitlines() if OWN.exists() else []
    for _, names, path in (line.split(":", 2) for line in ["0::/", f"0:{controller}:/", *lines] if line.count(":") > 1):
        if names and controller not in names.split(","):
            continue
        mount = ROOT / controller if names else ROOT
        inside = [group := mount / path.strip("/"), *group.parents]
        for folder, several in product(inside[: inside.index(mount) + 1], files):
            with suppress(OSError):  # no such group
                yield [word for name in several for word in (folder / name).read_text().split()]


# The GPU, if there is one that works: a driver that is too old for torch, or a GPU that torch's kernels do not know, is
# a sentence and no traceback.

DeviceName = Literal["cuda", "cpu"]


@cache
def gpu_found() -> tuple[bool, str]:
    """Whether torch finds a GPU; if it does not although it looked for one, why."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        found = torch.cuda.is_available()
    return found, "" if found or not said else first_line(UserWarning(said[-1].message))


@cache
def gpu_fault() -> str:
    """Why the GPU cannot be used, "" if it computes."""
    found, why = gpu_found()
    if not found:
        return why or f"torch {torch.__version__} finds none"
    try:
        right = float((torch.ones(2, device="cuda") * 2).sum()) == 4.0
    except Exception as error:  # whatever a driver or a library does
        return first_line(error)
    return "" if right else "it computes something else than the CPU"


def usable_device(asked: DeviceName | None) -> tuple[DeviceName, str]:
    """The device that is asked for, by default the GPU if it works, else the CPU; and a sentence, if a GPU fails.

    Raises UserError for a GPU that is asked for and cannot be used.
    """
    if asked == "cpu" or (asked is None and gpu_found() == (False, "")):
        return "cpu", ""
    fault = gpu_fault()
    if not fault:
        return "cuda", ""
    if asked is None:
        return "cpu", f"The GPU is not used: {fault}."
    raise UserError(
        f"--device cuda: the GPU cannot be used: {fault}\n"
        "    cause:  there is none, its driver is too old, or torch has no kernels for it\n"
        "    remedy: leave --device out; python -m sl_nerfstudio says what was found"
    )


# Processes that end with their parent, whatever ends it, and leave control-C to it.

_EXIT_ORPHANED = 1


def end_with_parent() -> None:
    """From now on, this process ends when its parent does."""
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Wait for the end of the parent: the pipe to it, which only it holds, is then closed by the kernel."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(_EXIT_ORPHANED)


@contextmanager
def no_interrupts() -> Iterator[None]:
    """Processes started in the block never see control-C: the terminal sends it to them, too, and each would print."""
    resource_tracker.ensure_running()  # when it starts by itself, it lets signals through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


# Freed memory is kept for the next array instead of being returned to the system.
#
# By default the C library maps each array of a few megabytes anew and returns it when it is freed. Then every page of
# the next one is a fault again, all threads of the process wait for each other in the kernel, and loops that make
# temporaries spend a third of their time there.

_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD = -1, -2, -3  # numbers of malloc.h


def keep_freed_memory() -> bool:
    """Arrays below 256 MiB come from memory that stays with the process; up to 1 GiB of it may be unused at its end.

    With glibc on Linux, whose `mallopt` this sets (mallopt(3)); elsewhere nothing changes. Returns whether it was set.
    """
    if sys.platform != "linux":
        return False
    library = _c_library()
    if not hasattr(library, "gnu_get_libc_version"):  # musl
        return False
    settings = ((_MMAP_THRESHOLD, 2**28), (_TRIM_THRESHOLD, 2**30), (_TOP_PAD, 2**26))
    return all([library.mallopt(number, value) == 1 for number, value in settings])


def return_freed_memory() -> None:
    """Give all freed memory back to the system after all, once (malloc_trim(3)); with glibc on Linux only."""
    if sys.platform == "linux" and hasattr(library := _c_library(), "malloc_trim"):
        library.malloc_trim(0)


def read_at_random(address: int, length: int) -> None:
    """Tell Linux that mapped memory will be read here and there: then it reads no megabytes around each place."""
    _advise(address, length, "MADV_RANDOM")


def read_in_order(address: int, length: int) -> None:
    """Tell Linux that mapped memory will be read from its beginning to its end: then it reads ahead."""
    _advise(address, length, "MADV_NORMAL")


def _advise(address: int, length: int, advice: str) -> None:
    """madvise(2) for whole pages; it is only a hint, so failure does not matter."""
    if sys.platform == "linux" and length > 0:
        first = address - address % mmap.PAGESIZE
        length += address - first
        _c_library().madvise(ctypes.c_void_p(first), ctypes.c_size_t(length), getattr(mmap, advice))


@cache
def _c_library() -> ctypes.CDLL:
    return ctypes.CDLL(None)


# Independent pieces of work in parallel, on as many threads as torch uses.
#
# The pieces are numba kernels that release the GIL. Idle threads sleep: unlike an OpenMP team they do not spin beside
# torch's own. Callers may be several threads (training, viewer) at once.

T = TypeVar("T")
U = TypeVar("U")

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
    """Operations of torch on one thread, our loops on all, for frequent calls: finding BLAS takes milliseconds."""
    global _ours
    before, count = _ours, torch.get_num_threads()
    torch_on_one_thread()
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
    """Put all libraries and our loops on one thread for good, in one of several processes that share the cores."""
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

    def keep(k: int) -> None:
        found[k] = tasks[k]()

    parallel([partial(keep, k) for k in range(len(tasks))])
    return [found[k] for k in range(len(tasks))]


def both(first: Callable[[], T], second: Callable[[], U]) -> tuple[T, U]:
    """What two tasks return; they run as in `parallel`."""
    found: list[Any] = results([first, second])
    return found[0], found[1]


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
    """Make one to `parts` ranges that cover 0..n, with boundaries at multiples of `multiple`."""
    step = max(-(-n // parts), 1)
    step = -(-step // multiple) * multiple
    return [(start, min(start + step, n)) for start in range(0, max(n, 1), step)]


# Machine code for loops that numpy cannot express; kept on disk, and made by one process while the others wait for it.
#
# numba alone lets all make it at once. Its list of a function's code then names a file that another process has not yet
# replaced: code for other arguments or of an earlier version, which ends the process with signal 11.

_SAID_AGAIN = 600.0  # seconds after which another process may say that it compiles


class _OneAtATime:
    """Held by the process, and there by the thread, that reads or makes machine code; a function may need others'."""

    def __init__(self, *folders: Path) -> None:
        """`folders`: the lock is a file in the first that can be written to."""
        self._folders, self._thread, self._depth, self._file = folders, threading.RLock(), 0, -1

    def __enter__(self) -> "_OneAtATime":
        """Wait until no other process holds it. One that ends, however it ends, holds it no longer."""
        self._thread.acquire()
        self._depth += 1
        for folder in self._folders if self._depth == 1 else ():
            with suppress(OSError):
                folder.mkdir(parents=True, exist_ok=True)
                self._file = os.open(folder / ".compiling", os.O_RDWR | os.O_CREAT, 0o666)
                fcntl.flock(self._file, fcntl.LOCK_EX)
                break
        return self

    def __exit__(self, *_: object) -> None:
        """Let others in."""
        self._depth -= 1
        if self._depth == 0 and self._file >= 0:
            os.close(self._file)
            self._file = -1
        self._thread.release()

    def say(self) -> None:
        """Tell who watches why it takes so long; one process does for all."""
        if self._file < 0 or not sys.stderr.isatty():
            return
        told = os.stat(self._file)
        if not told.st_size or time.time() - told.st_mtime > _SAID_AGAIN:
            os.pwrite(self._file, b"said", 0)
            print("compiling for this machine: a minute or two, once", file=sys.stderr, flush=True)


_compiling = _OneAtATime(Path(__file__).parent / "__pycache__", Path.home() / ".cache" / "sl-nerfstudio")


def shared(dispatcher: Any) -> Any:
    """A numba function whose code is read, or made and written, by one process at a time."""
    read_or_make = dispatcher.compile

    def alone(signature: Any) -> Any:
        with _compiling:
            made = read_or_make(signature)
            if dispatcher.stats.cache_misses:
                _compiling.say()
            return made

    dispatcher.compile = alone
    return dispatcher


_njit: Any = numba.njit  # its overloads do not accept options in a set
ANY_ORDER = {"contract", "reassoc", "nsz"}
"""For numba's `fastmath`: fused multiply-add, and sums in any order; infinity and NaN stay what they are."""


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function compiled for one thread; without the run-time type checks that tests wrap it in.

    Other threads run beside it. Division by zero gives infinity or NaN: a check of every divisor would keep loops from
    working on several numbers at once.
    """
    return shared(numba.njit(cache=True, nogil=True, error_model="numpy")(inspect.unwrap(function)))


def compiled_sums(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function compiled for one thread, with sums in any order: so several numbers are added at once."""
    return shared(_njit(cache=True, nogil=True, error_model="numpy", fastmath=ANY_ORDER)(inspect.unwrap(function)))


def compiled_range(function: Callable[..., None]) -> Callable[..., None]:
    """A loop over a range, compiled, run in pieces on all threads.

    `function(first, last, *arguments)` does the iterations first to last - 1, which must not depend on each other. The
    result is called with the number of iterations in place of the range. Unlike an OpenMP team (numba's `prange`), idle
    threads sleep: a team spins at the end of every loop, and beside other busy processes takes many times its share.
    """
    loop = compiled(function)

    def run(count: int, *arguments: Any) -> None:
        parallel([partial(loop, first, last, *arguments) for first, last in split(count, threads(), 1)])

    return run


_EACH = 4  # pieces of work of a thread between two reports


def tracked(tasks: Sequence[Callable[[], T]], words: str) -> list[T]:
    """What the tasks return, in their order; they must not depend on each other.

    Each draws from a random generator of its own, so that results do not depend on the number of threads.
    """
    together = _EACH * threads()
    batches = [tasks[first : first + together] for first in range(0, len(tasks), together)]
    return [found for batch in track(batches, words) for found in results(batch)]
