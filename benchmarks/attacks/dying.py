"""Commands that are killed at a chosen moment: at their n-th change of the disk, which no timing hits so exactly."""

import os
import signal
from collections.abc import Callable
from typing import Any

_CHANGES = ("write", "replace", "unlink", "mkdir", "rmdir", "ftruncate")


def die_at_change(moment: int, number: int = signal.SIGKILL) -> None:
    """From now on, this process sends itself a signal just before its change number `moment` of the disk, from 0.

    Folders of machine code do not count: which ones are made depends on what was imported before.
    """
    left = moment

    def watched(change: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            nonlocal left
            left -= "__pycache__" not in str(arguments[0])
            if left == -1:
                os.kill(os.getpid(), number)
            return change(*arguments, **named)

        return call

    for name in _CHANGES:
        setattr(os, name, watched(getattr(os, name)))
