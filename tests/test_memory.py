"""Freed memory stays with the process, where the C library lets it."""

import resource
import sys

import numpy as np

from sl_nerfstudio.memory import keep_freed_memory


def faults_of(array_bytes: int) -> int:
    """Page faults of making, filling and freeing an array."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    np.empty(array_bytes, np.uint8).fill(1)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


def test_an_array_reuses_the_pages_of_the_one_before():
    if keep_freed_memory():
        faults_of(96 << 20)
        assert faults_of(64 << 20) < 100  # fresh: 16,384, or 32 where pages have 2 MiB


def test_nothing_is_done_where_the_c_library_is_another(monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    assert not keep_freed_memory()
