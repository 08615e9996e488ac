"""Freed memory stays with the process, where the C library lets it."""

import resource
import sys
from pathlib import Path

import numpy as np

from sl_nerfstudio.memory import keep_freed_memory

MIB = 1 << 20


def resident_mib() -> float:
    """Memory of this process that lies in RAM (proc_pid_statm(5))."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / MIB


def test_freed_memory_stays_and_is_used_again():
    if keep_freed_memory():
        first = np.ones(96 * MIB, np.uint8)
        held = resident_mib()
        del first
        assert resident_mib() > held - 8  # returned: 96 less
        second = np.ones(64 * MIB, np.uint8)
        assert resident_mib() < held + 8  # mapped anew: 64 more
        del second


def test_nothing_is_done_where_the_c_library_is_another(monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    assert not keep_freed_memory()
