"""A new folder that is complete or not there at all, whatever ends the process that fills it."""

import json
import os
import sys
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path, PurePosixPath
from types import TracebackType

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.files.atomic import PARTIAL, require_empty, write_atomic
from sl_nerfstudio.files.lock import LOCK
from sl_nerfstudio.files.lock_file import LockFile
from sl_nerfstudio.files.paths import beside, made_with, remove_empty


class NewFolder:
    """Fills a new folder, alone. After an exception in its block, everything written is removed again.

    The lock in the folder lists the files before they are written, until the folder is complete. So what a killed
    process left can be told from files of the user: the next process that takes the folder removes it.

        with NewFolder(root) as folder:
            folder.write("images/a.png", ..)
            folder.write("transforms.json", .., last=True)
    """

    def __init__(self, root: Path) -> None:
        """Take the folder. Raises UserError if it holds anything else than what a killed process left, or is in use."""
        self.root = root
        self._written: list[str] = []
        if not os.path.lexists(root / LOCK):
            require_empty(root)
        self._made = made_with(root)
        try:
            self._lock = LockFile(root / LOCK, root)
            self._take()
        except BaseException:
            remove_empty(self._made)
            raise

    def _take(self) -> None:
        try:
            left = _listed(self._lock.lines)
            foreign = _foreign(self.root, left)
            if foreign is not None:
                raise _not_empty(self.root, foreign, self._lock)
            _remove(self.root, left)
            if left:
                print(f"{self.root}: removed what {self._lock.left_by} had not finished", file=sys.stderr)
            self._lock.hold()
        except BaseException:
            self._lock.release(remove=not self._lock.lines)
            raise

    def write(self, path: str, content: bytes, *, last: bool = False) -> None:
        """Write a file; `path` is relative to the folder, with / between folders.

        The `last` one is that without which the folder is not complete: it is never removed as left over.
        Raises UserError if it cannot be written, ValueError if it leaves the folder.
        """
        if not _inside(path):
            raise ValueError(f"{path!r} leaves the folder")
        if not last:
            self._lock.add(json.dumps(path).encode() + b"\n")
        self._written.append(path)
        write_atomic(self.root / path, content)

    def __enter__(self) -> "NewFolder":
        """The folder itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Let go of the folder; after an exception without what was written."""
        self.close(complete=kind is None)

    def close(self, complete: bool) -> None:
        """Let go of the folder, as at the end of the block; `complete`: keep what was written."""
        try:
            if not complete:
                _remove(self.root, self._written)
        finally:
            self._lock.release()
            if not complete:
                remove_empty(self._made)


def _inside(path: str) -> bool:
    parts = PurePosixPath(path)
    return bool(parts.parts) and not parts.is_absolute() and ".." not in parts.parts and "\0" not in path


def _listed(lines: Iterable[bytes]) -> list[str]:
    """The files that a killed process had listed; the last line may be cut off."""
    found = []
    for line in lines:
        with suppress(ValueError, RecursionError):
            path = json.loads(line)
            if isinstance(path, str) and _inside(path):
                found.append(path)
    return found


def _foreign(root: Path, left: Iterable[str]) -> Path | None:
    """Something below `root` that is neither listed, nor on the way to what is, nor the lock."""
    files = {root / path for path in left}
    known = files | {beside(path, PARTIAL) for path in files} | {root / LOCK}
    folders = {parent for path in files for parent in path.parents}
    for folder, inner, names in os.walk(root):
        for name in (*inner, *names):
            path = Path(folder, name)
            if path not in known and (path not in folders or path.is_symlink()):
                return path
    return None


def _remove(root: Path, paths: Iterable[str]) -> None:
    """Remove files with their temporary ones, and the folders between that are then empty."""
    files = [root / path for path in paths]
    for path in files:
        for name in (path, beside(path, PARTIAL)):
            with suppress(OSError):
                name.unlink(missing_ok=True)
    folders = {parent for path in files for parent in path.parents if root in parent.parents}
    remove_empty(sorted(folders, key=lambda folder: -len(folder.parts)))


def _not_empty(root: Path, foreign: Path, lock: LockFile) -> UserError:
    if lock.left_by is None:
        cause = "it holds an earlier result"
    else:
        cause = (
            f"{lock.left_by} was killed before it had finished, and {foreign.relative_to(root)} was not listed by it"
        )
    return UserError(
        f"{root}: is not empty\n    cause:  {cause}\n    remedy: choose another output, or remove it first"
    )
