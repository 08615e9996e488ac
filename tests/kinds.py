"""What tells a value from others of which a check of types may think otherwise: its type, shape, dtype, items."""

import re
from collections import defaultdict
from collections.abc import Callable, Collection, Hashable, Iterable
from functools import cache
from typing import Any

_ITEMS = 32  # of a container; those of more are not compared


class NotComparable(Exception):
    """Not everything is known that a check may ask for."""


class Kinds(defaultdict[type, Callable[[Any], Hashable]]):
    """By the type of a value: what tells it from others."""

    def __init__(self, records: bool, literals: bool) -> None:
        super().__init__()
        self.records = records  # are all items of a tuple checked, each by its own type?
        self.literals = literals  # do checks compare strings?

    def __missing__(self, of: type) -> Callable[[Any], Hashable]:
        self[of] = found = self._find(of)
        return found

    def of_all(self, values: Iterable[Any]) -> tuple[Hashable, ...]:
        """One by one."""
        return tuple([self[type(value)](value) for value in values])

    def _find(self, of: type) -> Callable[[Any], Hashable]:
        if of in (list, tuple, dict, set, frozenset):
            return self._container
        if issubclass(of, type) or (of is str and self.literals):
            return lambda value: value
        if hasattr(of, "shape") and hasattr(of, "dtype"):
            return lambda value: (of, value.dtype, value.shape)
        if issubclass(of, Collection) and not issubclass(of, str | bytes | range) and not hasattr(of, "_fields"):
            return _none
        return type

    def _container(self, value: Any) -> Hashable:
        """Of a container, a check looks at one item by chance, so that all have to be of one kind; not of a record."""
        if len(value) > _ITEMS:
            raise NotComparable
        keys, items = self.of_all(value), self.of_all(value.values() if type(value) is dict else ())
        if not (self.records and type(value) is tuple) and (len(set(keys)) > 1 or len(set(items)) > 1):
            raise NotComparable
        return type(value), keys, items


def _none(value: Any) -> Hashable:
    raise NotComparable


class _Never(Kinds):
    """For functions whose checks ask for more than kinds say."""

    def of_all(self, values: Iterable[Any]) -> tuple[Hashable, ...]:
        raise NotComparable


@cache
def kinds_for(annotations: str) -> Kinds:
    """What the checks of these annotations may ask for."""
    if re.search(r"\{|Literal\[[^'\"]", annotations):  # sizes that an argument says; numbers
        return _Never(False, False)
    records = not re.search(r"\.\.\.\]|Sequence|Collection|Iterable|Container", annotations)
    return _kinds(records, "Literal" in annotations)


_kinds = cache(Kinds)
