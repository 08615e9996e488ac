"""Time and memory of parts of one process."""

import os
import resource
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")
_RESET_PEAK = "5"  # proc(5), /proc/pid/clear_refs


@dataclass(frozen=True)
class Part:
    """What a part took."""

    seconds: float
    cpu_seconds: float  # of all threads
    peak_gb: float  # resident memory of the process during this part, libraries included


def measured(call: Callable[[], T]) -> tuple[T, Part]:
    """The result of a call, and what it took. Where the kernel cannot forget the peak, it is that since the start."""
    _forget_peak()
    wall, cpu = time.monotonic(), time.process_time()
    result = call()
    return result, Part(time.monotonic() - wall, time.process_time() - cpu, peak_gb())


def peak_gb() -> float:
    """Largest resident memory since the start, or since it was forgotten."""
    status = Path("/proc/self/status")
    if status.exists():
        words = next((line.split() for line in status.read_text().splitlines() if line.startswith("VmHWM")), None)
        if words is not None:
            return int(words[1]) / 1024**2
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2


def _forget_peak() -> None:
    path = Path(f"/proc/{os.getpid()}/clear_refs")
    if path.exists():
        path.write_text(_RESET_PEAK)
