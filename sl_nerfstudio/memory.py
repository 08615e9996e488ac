"""Freed memory is kept for the next array instead of being returned to the system.

By default the C library maps each array of a few megabytes anew and returns it when it is freed. Then every page of the
next one is a fault again, all threads of the process wait for each other in the kernel, and loops that make
temporaries spend a third of their time there.
"""

import ctypes
import mmap
import sys
from functools import cache

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
