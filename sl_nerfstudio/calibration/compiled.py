"""Machine code for loops that numpy cannot express."""

import inspect
from collections.abc import Callable
from typing import Any

import numba


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function compiled, parallel, kept on disk; without the run-time type checks that tests wrap it in."""
    return numba.njit(parallel=True, cache=True)(inspect.unwrap(function))


def compiled_part(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same for what compiled loops call, in one thread."""
    return numba.njit(cache=True)(inspect.unwrap(function))
