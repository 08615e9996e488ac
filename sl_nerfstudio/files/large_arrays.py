"""Arrays that grow piece by piece, or are many: in memory, or in a temporary file once they are large.

The file lies in the folder for temporary files (TMPDIR) and has no name: it is gone with the process, whatever ends it.
The operating system keeps in memory what is used of it.
"""

import math
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import IO

import numpy as np
from numpy import ndarray

from sl_nerfstudio.control_groups import OWN, ROOT, groups_around
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.memory import return_freed_memory

_ALIGNMENT = 64  # bytes, of arrays in a file
_SHARE = 8  # of the memory that this process may use, as a divisor: beyond it, an array goes to a file
_LIMITS = ("memory.max", "memory.limit_in_bytes")  # of control groups, versions 2 and 1


def largest_in_memory() -> int:
    """Bytes beyond which an array is kept in a file."""
    return memory_of_process() // _SHARE


def memory_of_process() -> int:
    """Bytes of memory that this process may use."""
    return usable_memory(ROOT, OWN)


def usable_memory(root: Path, own: Path) -> int:
    """Bytes of memory of the machine, or fewer if the control groups of this process allow fewer.

    For the arguments see `control_groups.groups_around`.
    """
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    files = (folder / name for folder in groups_around("memory", root, own) for name in _LIMITS)
    return min([machine, *(limit for file in files if (limit := _limit(file)) is not None)])


class GrowingArray:
    """Pieces with the same type and the same shape but for their length, one after the other."""

    def __init__(self, most_bytes: int) -> None:
        """`most_bytes`: beyond, the pieces go to a file."""
        self._most = most_bytes
        self._pieces: list[ndarray] = []
        self._bytes = 0
        self._file: IO[bytes] | None = None

    def append(self, piece: ndarray) -> None:
        """Add a piece at the end. Raises UserError if the disk is full."""
        self._pieces.append(np.ascontiguousarray(piece))
        self._bytes += piece.nbytes
        if self._bytes > self._most:
            self._write()

    def whole(self) -> ndarray:
        """All pieces as one array, mapped into memory if they are in a file. No piece may be added afterwards."""
        if self._file is None:
            pieces, self._pieces = self._pieces, []
            return np.concatenate(pieces)
        like = self._like
        length = self._bytes // (like.itemsize * math.prod(like.shape[1:]))
        with self._file as file:  # the mapped array does not need it
            file.flush()
            return np.memmap(file, like.dtype, "r+", shape=(length, *like.shape[1:]))

    def _write(self) -> None:
        self._like = self._pieces[0][:0]
        first = self._file is None
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile()  # noqa: SIM115  # `whole` closes it
            for piece in self._pieces:
                self._file.write(piece.tobytes())
        except OSError as error:
            raise _no_space(error, self._bytes) from error
        self._pieces = []
        if first:  # many pieces; from now on there is one at a time
            return_freed_memory()


def in_file(arrays: Sequence[ndarray]) -> list[ndarray]:
    """The same arrays, mapped into memory from one temporary file. Raises UserError if the disk is full."""
    firsts, end = [], 0
    for array in arrays:
        firsts.append(end)
        end += -(-array.nbytes // _ALIGNMENT) * _ALIGNMENT
    try:
        with tempfile.TemporaryFile() as file:
            for first, array in zip(firsts, arrays, strict=True):
                file.seek(first)
                file.write(np.ascontiguousarray(array).data)
            file.truncate(max(end, 1))  # nothing can be mapped from an empty file
            mapped = np.asarray(np.memmap(file, np.uint8, "r+"))
    except OSError as error:
        raise _no_space(error, end) from error
    return [
        mapped[first : first + array.nbytes].view(array.dtype).reshape(array.shape)
        for first, array in zip(firsts, arrays, strict=True)
    ]


def _no_space(error: OSError, size: int) -> UserError:
    return UserError(
        f"{tempfile.gettempdir()}: cannot write a temporary file ({error.strerror})\n"
        f"    cause:  the scan is too large for the memory, and {size / 2**30:.1f} GB do not fit there\n"
        "    remedy: set TMPDIR to a folder on a disk with more space"
    )


def _limit(file: Path) -> int | None:
    try:
        return int(file.read_text())
    except (OSError, ValueError):  # no such group, or "max"
        return None
