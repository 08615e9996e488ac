"""Machine code for loops that numpy cannot express; kept on disk, so that it is made once."""

import inspect
import os
from collections.abc import Callable
from typing import Any

# Read by OpenMP when numba first starts its threads: idle ones sleep. By default they spin at the end of every parallel
# loop, and beside other busy processes a loop then takes many times its share of the machine.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numba


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function compiled for one thread; without the run-time type checks that tests wrap it in."""
    return numba.njit(cache=True)(inspect.unwrap(function))


def compiled_parallel(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same, with `numba.prange` over all threads."""
    return numba.njit(parallel=True, cache=True)(inspect.unwrap(function))
