"""nerfstudio imported without torch's compiler, which takes longer to import than all the rest.

torchvision and one of nerfstudio's models ask for the compiler as soon as they are imported, to use it in functions
that an export never calls. Within `compiler_on_demand()` they get functions that fetch it when they are called.
"""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial, wraps
from importlib import import_module
from types import ModuleType
from typing import Any

import torch

_COMPILER, _ASKED = "torch._dynamo", "is_compile_supported"


@contextmanager
def compiler_on_demand() -> Iterator[None]:
    """For the duration of imports; what they decorate with `torch.compile` is compiled when it is first called."""
    real = torch.compile
    torch.compile = partial(_compiled_later, real)  # pyright: ignore[reportAttributeAccessIssue]
    names = [] if _COMPILER in sys.modules else [_COMPILER, f"{_COMPILER}.utils"]
    sys.modules.update({name: _Placeholder(name) for name in names})
    try:
        yield
    finally:
        torch.compile = real
        _remove_placeholders()


class _Placeholder(ModuleType):
    """Stands for a module of the compiler that nobody has needed so far."""

    def __getattr__(self, name: str) -> Any:
        if name == _ASKED:
            return _is_compile_supported
        other_part = name == "__path__" and self.__name__ == _COMPILER
        if name.startswith("__") and not other_part:  # `inspect` asks all modules for their files
            raise AttributeError(name)
        _remove_placeholders()
        return getattr(import_module(self.__name__), name)


def _remove_placeholders() -> None:
    for name in (_COMPILER, f"{_COMPILER}.utils"):
        if isinstance(sys.modules.get(name), _Placeholder):
            del sys.modules[name]


def _is_compile_supported(device_type: str) -> bool:
    _remove_placeholders()
    return getattr(import_module(f"{_COMPILER}.utils"), _ASKED)(device_type)


def _compiled_later(real: Callable[..., Any], model: Any = None, **settings: Any) -> Any:
    """`torch.compile`, also as a decorator with settings."""
    if model is None:
        return partial(_compiled_later, real, **settings)
    if isinstance(model, torch.nn.Module):
        return real(model, **settings)
    compiled = cache(partial(real, model, **settings))

    @wraps(model)
    def run(*arguments: Any, **named: Any) -> Any:
        return compiled()(*arguments, **named)

    return run
