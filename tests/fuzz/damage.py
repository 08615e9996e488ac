"""Ways to damage a JSON document or a file; every choice is drawn by hypothesis."""

import copy
from collections.abc import Iterator
from typing import Any

from hypothesis import strategies as st

DEEP: Any = 0
for _ in range(500):
    DEEP = [DEEP]

IMPOSSIBLE = [
    float("nan"), float("inf"), 1e308, -1e308, 1e30, -1e30, 10**400, -1, "", "x", "1.0", "../x", "/etc/passwd", "a\0b",
    "\ud800", None, True, [], {}, [[]], [1], {"a": 1}, [float("nan")] * 4, [[1e308] * 4] * 4, DEEP,
]  # fmt: skip
"""Values that are right nowhere in a scan, or in hardly any place."""

Path = tuple[str | int, ...]


def places(value: Any, path: Path = ()) -> Iterator[Path]:
    """The path of every value in a document."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        yield (*path, key)
        yield from places(item, (*path, key))


def replaced(document: Any, path: Path, value: Any) -> Any:
    """A copy of the document with another value at a place."""
    out = copy.deepcopy(document)
    at(out, path[:-1])[path[-1]] = value
    return out


def removed(document: Any, path: Path) -> Any:
    """A copy of the document without a place."""
    out = copy.deepcopy(document)
    del at(out, path[:-1])[path[-1]]
    return out


def at(document: Any, path: Path) -> Any:
    """The value at a place."""
    for key in path:
        document = document[key]
    return document


@st.composite
def damaged(draw: st.DrawFn, content: bytes) -> bytes:
    """A file with a changed byte, a cut end, a hole, or something in between."""
    place = draw(st.integers(0, len(content) - 1))
    match draw(st.sampled_from(("flip", "flip", "flip", "cut", "hole", "insert", "repeat"))):
        case "flip":
            flipped = content[place] ^ (1 << draw(st.integers(0, 7)))
            return content[:place] + bytes([flipped]) + content[place + 1 :]
        case "cut":
            return content[:place]
        case "hole":
            return content[:place] + content[place + draw(st.integers(1, 64)) :]
        case "insert":
            return content[:place] + draw(st.binary(min_size=1, max_size=16)) + content[place:]
        case _:
            return content[:place] + content[: draw(st.integers(1, 256))] + content[place:]
