"""Commands that are killed at a chosen moment: at their n-th change of the disk, which no timing hits so exactly."""

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

_CHANGES = ("write", "replace", "unlink", "mkdir", "rmdir", "ftruncate")


@contextmanager
def dying(moment: int, number: int = signal.SIGKILL) -> Iterator[None]:
    """Processes forked in the block send themselves a signal just before their change number `moment`, from 0."""
    parent, left = os.getpid(), [moment]

    def watched(change: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            if os.getpid() != parent:
                left[0] -= 1
                if left[0] == -1:
                    os.kill(os.getpid(), number)
            return change(*arguments, **named)

        return call

    before = {name: getattr(os, name) for name in _CHANGES}
    for name, change in before.items():
        setattr(os, name, watched(change))
    try:
        yield
    finally:
        for name, change in before.items():
            setattr(os, name, change)
