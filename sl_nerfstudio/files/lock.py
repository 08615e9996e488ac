"""Outputs of one process alone: a second one on the same folder or file is refused."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.files.lock_file import LockFile
from sl_nerfstudio.files.paths import beside, made_with, remove_empty, require_possible

LOCK = ".sl-lock"
"""Name of the lock in a folder."""


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold a folder; it is made if it does not exist, and removed again if it then stays empty.

    A lock that a killed process left is taken over. Raises UserError if another process holds the folder (it says
    which), if it holds an output that was not finished, or if it cannot be written to.
    """
    with _locked(folder / LOCK, folder, folder):
        yield


@contextmanager
def locked_file(path: Path) -> Iterator[None]:
    """The same for one file; others in its folder may be outputs of other processes."""
    with _locked(beside(path, "sl-lock"), path, path.parent):
        yield


@contextmanager
def _locked(lock: Path, output: Path, folder: Path) -> Iterator[None]:
    made = made_with(folder)
    try:
        require_possible(output)
        held = LockFile(lock, output)
        if held.lines:
            held.release(remove=False)
            raise UserError(
                f"{output}: is not finished\n    cause:  {held.left_by} was killed while it wrote there\n"
                "    remedy: run that command again, remove the folder, or choose another output"
            )
        try:
            held.hold()
            yield
        finally:
            held.release()
    finally:
        remove_empty(made)
