"""How the package is checked at run time while tests run: by beartype, but for kernels, whose types only Warp knows."""

from collections.abc import Callable
from typing import Any

from beartype import beartype


def checked(function: Callable[..., Any], *options: Any, **named: Any) -> Callable[..., Any]:
    """The function with checks of its types."""
    kernels = ".warp_kernels." in getattr(function, "__module__", "")
    return function if kernels else beartype(function, *options, **named)
