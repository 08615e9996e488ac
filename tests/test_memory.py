"""Freed memory stays with the process, where the C library lets it; how mapped memory is read."""

import mmap
import resource
import sys
from pathlib import Path

import numpy as np
import pytest

from sl_nerfstudio.parallel import keep_freed_memory, read_at_random, read_in_order

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


@pytest.mark.skipif(sys.platform != "linux", reason="other systems are told nothing")
def test_the_system_is_told_how_mapped_memory_is_read(tmp_path: Path) -> None:
    """Its own flags of the mapping: "rr" is random read (proc_pid_smaps(5))."""
    (tmp_path / "file").write_bytes(bytes(4 * mmap.PAGESIZE))
    array = np.memmap(tmp_path / "file", np.uint8, "r")

    def flags() -> list[str]:
        found = [line.split() for line in Path("/proc/self/smaps").read_text().splitlines()]
        starts = [k for k, words in enumerate(found) if words and words[-1] == str(tmp_path / "file")]
        assert len(starts) == 1
        return next(words[1:] for words in found[starts[0] :] if words[0] == "VmFlags:")

    assert "rr" not in flags()
    read_at_random(array.ctypes.data + 5, array.nbytes - 5)
    assert "rr" in flags()
    read_in_order(array.ctypes.data, array.nbytes)
    assert "rr" not in flags()
    read_at_random(array.ctypes.data, 0)
    assert "rr" not in flags()
