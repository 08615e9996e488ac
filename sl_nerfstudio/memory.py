"""Freed memory is kept for the next array instead of being returned to the system.

By default the C library maps each array of a few megabytes anew and returns it when it is freed. Then every page of the
next one is a fault again, all threads of the process wait for each other in the kernel, and loops that make
temporaries spend a third of their time there.
"""

import ctypes
import sys

_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD = -1, -2, -3  # numbers of malloc.h


def keep_freed_memory() -> bool:
    """Arrays below 256 MiB come from memory that stays with the process; up to 1 GiB of it may be unused at its end.

    With glibc on Linux, whose `mallopt` this sets (mallopt(3)); elsewhere nothing changes. Returns whether it was set.
    """
    if sys.platform != "linux":
        return False
    library = ctypes.CDLL(None)
    if not hasattr(library, "gnu_get_libc_version"):  # musl
        return False
    settings = ((_MMAP_THRESHOLD, 2**28), (_TRIM_THRESHOLD, 2**30), (_TOP_PAD, 2**26))
    return all([library.mallopt(number, value) == 1 for number, value in settings])
