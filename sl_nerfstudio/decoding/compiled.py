"""Functions as machine code."""

import inspect
from collections.abc import Callable
from typing import Any

import numba


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function compiled by numba; without the run-time type checks that tests wrap it in."""
    return numba.njit(cache=True)(inspect.unwrap(function))
