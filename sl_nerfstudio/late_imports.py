"""Imports of other libraries without parts that this package never uses: seconds of every command's start.

CPU seconds on one core, with torch 2.11, nerfstudio 1.1.5 and open3d 0.19:
- `ns-train sl-neus`, `sl-export`: nerfstudio's import takes 5.9 instead of 9.7 without the compiler, torch._dynamo.
  torchvision and one of nerfstudio's models ask for it as soon as they are imported, to use it in functions that this
  package never calls, and torch's optimisers ask it to leave them alone. Within `compiler_on_demand()` they get
  functions that fetch it when they are called.
- `sl-synth`, `sl-eval`, `sl-export`: open3d's import takes 0.1 instead of 2.5 (besides torch's) without its web viewer
  and its machine learning (dash, sklearn, pandas).

All of it can still be imported later. tests/test_late_imports.py fails where a library no longer asks for these parts.
"""

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache, partial, wraps
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import torch

_OURS = __name__.partition(".")[0]
_COMPILER, _ASKED = "torch._dynamo", "is_compile_supported"
_importing = ExitStack()


@contextmanager
def compiler_on_demand(stays_out: bool = False) -> Iterator[None]:
    """Leave the compiler out of imports in the block; what `torch.compile` decorates is compiled when it is called.

    With `stays_out` torch itself does not fetch the compiler afterwards, either, until something compiles.
    """
    real = torch.compile
    torch.compile = partial(_compiled_later, real)  # pyright: ignore[reportAttributeAccessIssue]
    names = [] if _COMPILER in sys.modules else [_COMPILER, f"{_COMPILER}.utils"]
    sys.modules.update({name: _Placeholder(name) for name in names})
    try:
        yield
    finally:
        torch.compile = real
        if not stays_out:
            _remove_placeholders()


def begin_imports(command: list[str]) -> None:
    """Begin to leave the compiler out; called by what nerfstudio imports first of this package, with the command line.

    If that trains one of this package's methods, or loads a run of one, nothing in the process needs the compiler.
    """
    if _trains_or_loads(command):
        _importing.enter_context(compiler_on_demand(stays_out=True))


def _trains_or_loads(command: list[str]) -> bool:
    name, words = Path(command[0]).stem, command[1:]
    if not name.startswith("ns-"):
        return False
    if name == "ns-train" and any(word.startswith("sl-neus") for word in words[:1]):
        return True
    given = [after for word, after in pairwise([*words, ""]) if word == "--load-config"]
    given += [word.partition("=")[2] for word in words if word.startswith("--load-config=")]
    return any(_begins_with(Path(path), f"{_OURS}.") for path in given)


def _begins_with(path: Path, name: str) -> bool:
    """Whether the first line of a file has a name; False if it cannot be read."""
    try:
        with path.open(errors="replace") as file:
            return name in file.readline(1000)
    except OSError:
        return False


def end_imports() -> None:
    """End what `begin_imports` began; called by what nerfstudio imports last of this package."""
    _importing.close()


class _Placeholder(ModuleType):
    """Stands for a module of the compiler that nobody has needed so far."""

    def __getattr__(self, name: str) -> Any:
        if name in _WITHOUT:
            return _WITHOUT[name]
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


def _disable(function: Any = None, *_: Any, **settings: Any) -> Any:
    """What nothing compiles need not be kept from the compiler."""
    return partial(_disable, **settings) if function is None else function


def _graph_break(*_: Any, **__: Any) -> None:
    """Nothing is being traced."""


_WITHOUT = {_ASKED: _is_compile_supported, "disable": _disable, "graph_break": _graph_break}


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


# open3d.

_LEFT_OUT = {"open3d.ml": (), "open3d.visualization.draw_plotly": ("draw_plotly", "draw_plotly_server")}


def _import_core() -> ModuleType:
    stand_ins = {}
    for name, members in _LEFT_OUT.items() if "open3d" not in sys.modules else ():
        stand_ins[name] = ModuleType(name)
        for member in members:  # which open3d imports by name
            setattr(stand_ins[name], member, None)
    sys.modules.update(stand_ins)
    try:
        import open3d as core
    finally:
        for name in stand_ins:
            sys.modules.pop(name, None)
    return core


if TYPE_CHECKING:
    import open3d
else:
    open3d = _import_core()
