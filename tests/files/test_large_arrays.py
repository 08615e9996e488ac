"""Arrays that grow: the same whole array from memory and from a file."""

import os
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

from sl_nerfstudio import storage
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.storage import (
    GrowingArray,
    in_file,
    largest_in_memory,
    usable_memory,
)


@pytest.mark.parametrize("most", [0, 100, 10**6])
def test_the_whole_is_what_was_added(most, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    rng, grown = np.random.default_rng(0), GrowingArray(most)
    pieces = [rng.random((n, 2)).astype(np.float32) for n in (5, 0, 30, 1)]
    for piece in pieces:
        grown.append(piece[:, ::-1])
    whole = grown.whole()
    assert whole.dtype == np.float32 and isinstance(whole, np.memmap) == (most < 288)
    np.testing.assert_array_equal(whole, np.concatenate(pieces)[:, ::-1])
    whole[0] = 7  # as an array in memory
    assert not list(tmp_path.iterdir())  # the file has no name that could stay behind


@pytest.mark.skipif(sys.platform != "linux", reason="resident memory is read from /proc")
def test_pieces_that_went_to_a_file_take_no_memory(tmp_path, monkeypatch):
    """Else freed memory would stay with the process, where the file's pages should be."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))

    def own() -> int:
        status = Path("/proc/self/status").read_text()
        return int(status.split("RssAnon:")[1].split()[0]) // 1024

    before, grown = own(), GrowingArray(200 << 20)
    for k in range(200):
        grown.append(np.full(1 << 17, float(k)))  # a megabyte each, as small as arrays that the C library keeps
    assert own() > before + 150
    grown.append(np.zeros(1 << 17))
    assert own() < before + 50
    assert grown.whole()[5 << 17] == 5


def test_no_place_for_the_file_is_a_fault_of_the_user(monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", "/dev/null/nowhere")
    with pytest.raises(UserError, match=r"temporary file.*\n.*\n.*TMPDIR"):
        GrowingArray(0).append(np.zeros(3))


@pytest.mark.parametrize(
    ("own", "group", "text", "expected"),
    [
        ("0::/\n", "memory.max", "8000000\n", 8000000),  # a container
        ("0::/a/b\n", "a/memory.max", "8000000\n", 8000000),  # the group around the process's own
        ("4:memory:/a\n0::/\n", "memory/a/memory.limit_in_bytes", "8000000\n", 8000000),
        ("0::/a\n", "b/memory.max", "8000000\n", None),  # another group
        ("0::/\n", "memory.max", "max\n", None),
        ("4:memory:/\n", "memory/memory.limit_in_bytes", "9223372036854771712\n", None),  # version 1 without a limit
        ("", "nothing", "", None),
    ],
)
def test_memory_is_as_much_as_control_groups_allow(own, group, text, expected, tmp_path, monkeypatch):
    (tmp_path / group).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / group).write_text(text)
    (tmp_path / "own").write_text(own)
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    assert usable_memory(tmp_path, tmp_path / "own") == (expected or machine)
    monkeypatch.setattr(storage, "ROOT", tmp_path)
    monkeypatch.setattr(storage, "OWN", tmp_path / "own")
    assert largest_in_memory() == (expected or machine) // 8


def test_arrays_in_a_file_are_the_same_arrays(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    rng = np.random.default_rng(0)
    arrays = [rng.random((5, 3))[:, ::2], np.zeros((0, 2)), rng.random(7) > 0.5, np.float32([[1, np.nan]]), np.eye(4)]
    found = in_file(arrays)
    for array, same in zip(arrays, found, strict=True):
        assert same.dtype == array.dtype and same.shape == array.shape
        np.testing.assert_array_equal(same, array)
    found[-1][0, 0] = 7  # as an array in memory
    assert found[-1].sum() == 10 and not list(tmp_path.iterdir())
    assert in_file([]) == [] and in_file([np.zeros(0)])[0].shape == (0,)


def test_no_place_for_arrays_is_a_fault_of_the_user(monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", "/dev/null/nowhere")
    with pytest.raises(UserError, match=r"temporary file.*\n.*\n.*TMPDIR"):
        in_file([np.zeros(3)])
