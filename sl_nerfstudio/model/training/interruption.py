"""SIGINT and SIGTERM: a command ends without a traceback, and with the status that shells expect."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(SystemExit):
    """The process was asked to stop; the status is 128 + the signal's number (130 or 143)."""


class Interruption:
    """Turns the first signal into `Interrupted`, and ends the process at once on the second.

    Between `hold` and `release` the first signal waits, because half a training step cannot be continued.
    """

    def __init__(self) -> None:
        self._previous: dict[int, object] = {}
        self._received: int | None = None
        self._raised = False
        self._held = False

    def install(self) -> None:
        """Handle the signals from now on. A signal that the process was started to ignore remains ignored."""
        if self._previous or threading.current_thread() is not threading.main_thread():
            return
        self._received, self._raised, self._held = None, False, False
        for number in _SIGNALS:
            before = signal.getsignal(number)
            if before is not signal.SIG_IGN:
                self._previous[number] = before
                signal.signal(number, self._handle)

    def remove(self) -> None:
        """Restore what handled the signals before."""
        for number, handler in self._previous.items():
            signal.signal(number, handler)  # type: ignore[arg-type]
        self._previous.clear()
        self._held = False

    def hold(self) -> None:
        """Let a signal wait for `release`."""
        self._held = True

    def release(self) -> None:
        """Raise `Interrupted` if a signal has been waiting."""
        self._held = False
        self._raise_received()

    @property
    def received(self) -> int:
        """Number of the first signal; 0 if there was none."""
        return self._received or 0

    def receive(self, number: int) -> None:
        """Count a signal that another process of this training received."""
        self._received = number or self._received

    @contextmanager
    def held(self) -> Iterator[None]:
        """Let a signal wait for the end of the block, or of the block around it."""
        before, self._held = self._held, True
        try:
            yield
        finally:
            self._held = before
        if not before:
            self._raise_received()

    def _raise_received(self) -> None:
        if self._received is not None and not self._raised:
            self._raised = True
            raise Interrupted(128 + self._received)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._received is not None:
            os._exit(128 + number)
        self._received = number
        said = b"terminated\n" if number == signal.SIGTERM else b"interrupted\n"
        os.write(2, said)  # print is not allowed here
        if not self._held:
            self._raise_received()


INTERRUPTION = Interruption()
"""Of this process: signal handlers belong to the whole process, too."""
