"""A progress bar for work that a person waits for."""

import sys
import time
from collections.abc import Iterable, Iterator
from typing import TypeVar

T = TypeVar("T")

SHOW_AFTER_SECONDS = 2.0
_shown = False  # one bar at a time: nested bars would overwrite the same line


def track(iterable: Iterable[T], description: str, total: int | None = None) -> Iterator[T]:
    """Yield the items of `iterable`, with a bar on stderr once the work has taken two seconds.

    Shows nothing if stderr is not a terminal, for short work, and inside another tracked loop.
    `total` is the number of items, by default `len(iterable)` if that exists.
    """
    global _shown
    if total is None and hasattr(iterable, "__len__"):
        total = len(iterable)  # type: ignore[arg-type]
    if not sys.stderr.isatty():
        yield from iterable
        return
    iterator = iter(iterable)
    start = time.monotonic()
    done = 0
    for item in iterator:
        yield item
        done += 1
        if not _shown and time.monotonic() - start > SHOW_AFTER_SECONDS:
            _shown = True
            break
    else:
        return
    try:
        yield from _with_bar(iterator, description, total, done)
    finally:
        _shown = False


def _with_bar(iterator: Iterator[T], description: str, total: int | None, done: int) -> Iterator[T]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(description, total=total, completed=done)
        for item in iterator:
            yield item
            progress.advance(task)
