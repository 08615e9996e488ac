"""Types, shapes and dtypes are checked at run time while tests run: by jaxtyping and beartype, once for calls alike.

A check asks for nothing but types, shapes and dtypes, and for what strings say. It takes forty microseconds, and some
tests call a million functions: so what was right once is not looked at again. Calls that cannot be compared (a long
list, one whose items differ) are checked every time. Comparing takes eight microseconds: of functions that a process
calls often, it is done for one call of several.
"""

import inspect
import threading
from collections.abc import Callable, Hashable
from dataclasses import is_dataclass
from functools import cached_property, partial, wraps
from types import CodeType, FunctionType
from typing import Any

import jaxtyping
from beartype import beartype

from tests.kinds import Kinds, NotComparable, kinds_for

_fully_checked = partial(jaxtyping.jaxtyped, typechecker=beartype)
_CALLS = 10_000  # of one function, all different: then they are forgotten
_ALL, EVERY = 300, 16  # of the calls of one function the first 300 are looked at, then one of 16


def install() -> None:
    """In everything of the package that is imported from here on."""
    jaxtyping.install_import_hook("sl_nerfstudio", "beartype.beartype")
    jaxtyping.jaxtyped = checked  # what the hook decorates functions and classes with


def checked(function: Callable[..., Any] | None = None, *, typechecker: Any = None) -> Any:
    """The function with checks of its types; a dataclass with those of its fields."""
    if function is None:
        return checked
    if inspect.isclass(function):
        if is_dataclass(function) and not hasattr(function.__init__, "checks"):
            function.__init__ = _checked(function.__init__)
        return function
    # The types of a kernel only Warp knows.
    return function if ".warp_kernels." in function.__module__ else _checked(function)


class _Checks:
    """Of one function, made when they are first needed. Closures of the same code share what was right."""

    _of_code: dict[int, tuple[CodeType, dict[Hashable, set[Hashable]]]] = {}  # noqa: RUF012

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function
        self.right = self._of_code.setdefault(id(function.__code__), (function.__code__, {}))[1]
        self.calls = 0

    @cached_property
    def kinds(self) -> Kinds:
        """How calls of the function are compared."""
        return kinds_for(str([*self.function.__annotations__.values()]))

    @cached_property
    def call(self) -> Callable[..., Any]:
        """The function with all checks."""
        return _fully_checked(self.function)

    def result(self, result: Any, *args: Any, **named: Any) -> None:
        """Checks what the function returned for these arguments."""
        self._given.result = result
        self._returned(*args, **named)

    @cached_property
    def _given(self) -> threading.local:
        return threading.local()

    @cached_property
    def _returned(self) -> Callable[..., Any]:
        """A function with the same signature that returns what was given; the types are stated in its globals."""
        given, function = self._given, self.function

        def returned(*_: Any, **__: Any) -> Any:
            return given.result

        same = FunctionType(returned.__code__, function.__globals__, function.__name__, None, returned.__closure__)
        return _fully_checked(wraps(function)(same))


def _checked(function: Callable[..., Any]) -> Callable[..., Any]:
    checks = _Checks(function)
    right = checks.right

    @wraps(function)
    def call(*args: Any, **named: Any) -> Any:
        __tracebackhide__ = True
        checks.calls += 1
        if checks.calls > _ALL and checks.calls % EVERY:
            return function(*args, **named)
        kinds = checks.kinds
        try:
            given = kinds.of_all(args), tuple(named), kinds.of_all(named.values())
        except NotComparable:
            given = None  # and the call comes afterwards: its errors are no consequence of this one
        if given is None:
            return checks.call(*args, **named)
        returned = right.get(given)
        result = checks.call(*args, **named) if returned is None else function(*args, **named)
        try:
            kind = kinds[type(result)](result)
        except NotComparable:
            kind = None
        if returned is None:
            if len(right) >= _CALLS:
                right.clear()
            right[given] = {kind}
        elif kind is None or kind not in returned:
            checks.result(result, *args, **named)
            returned.add(kind)
        return result

    call.checks = checks  # type: ignore[attr-defined]
    return call
