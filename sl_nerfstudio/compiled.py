"""Machine code for loops that numpy cannot express; kept on disk, so that it is made once."""

import inspect
from collections.abc import Callable
from functools import partial
from typing import Any

import numba

from sl_nerfstudio.threads import parallel, split, threads

_njit: Any = numba.njit  # its overloads do not accept options in a set
ANY_ORDER = {"contract", "reassoc", "nsz"}
"""For numba's `fastmath`: fused multiply-add, and sums in any order; infinity and NaN stay what they are."""


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function compiled for one thread; without the run-time type checks that tests wrap it in.

    Other threads run beside it. Division by zero gives infinity or NaN: a check of every divisor would keep loops from
    working on several numbers at once.
    """
    return numba.njit(cache=True, nogil=True, error_model="numpy")(inspect.unwrap(function))


def compiled_sums(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function compiled for one thread, with sums in any order: so several numbers are added at once."""
    return _njit(cache=True, nogil=True, error_model="numpy", fastmath=ANY_ORDER)(inspect.unwrap(function))


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
