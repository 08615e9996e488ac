"""A file that one process holds, with a note of which process that is.

The kernel releases the file when its process ends, however it ends (flock), so one that a killed process left blocks
nobody. Where a file system knows no locks, the note decides.
"""

import errno
import fcntl
import json
import os
import socket
import sys
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.files.paths import cannot_write

_NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS, errno.EINVAL, errno.EBADF)


@dataclass(frozen=True)
class Holder:
    """A process, as it notes itself in the files that it holds."""

    command: str
    process: int
    host: str
    since: str  # date and time

    @staticmethod
    def here() -> "Holder":
        """This process."""
        since = datetime.now().isoformat(" ", "seconds")
        return Holder(Path(sys.argv[0]).name, os.getpid(), socket.gethostname(), since)

    @staticmethod
    def read(note: bytes) -> "Holder | None":
        """From a note; None if the text is none."""
        try:
            found = json.loads(note)["sl-nerfstudio"]
            return Holder(str(found["command"]), int(found["process"]), str(found["host"]), str(found["since"]))
        except (ValueError, KeyError, TypeError, RecursionError):
            return None

    def note(self) -> bytes:
        """One line of text."""
        return json.dumps({"sl-nerfstudio": vars(self)}).encode() + b"\n"

    def may_run(self) -> bool:
        """Whether the process runs, or is one of another machine and cannot be asked."""
        if self.host != socket.gethostname():
            return True
        try:
            os.kill(self.process, 0)
        except ProcessLookupError:
            return False
        except PermissionError:
            return True  # of another user
        return self.process != os.getpid()

    def __str__(self) -> str:
        """In words."""
        return f"{self.command} (process {self.process} on {self.host}, since {self.since})"


class LockFile:
    """A file held by this process until `release`, which removes it."""

    left_by: Holder | None  # the process that was killed while it held the file
    lines: list[bytes]  # what that process had added

    def __init__(self, path: Path, output: Path) -> None:
        """Make or take over the file. `output` is what it protects.

        Raises UserError if another process holds it, if it is no such file, or if it cannot be written.
        """
        self.path, self.output = path, output
        try:
            self._file, locked = open_alone(path)
        except BlockingIOError:
            raise in_use(output, _holder(path)) from None
        except OSError as error:
            raise cannot_write(output, error) from error
        try:
            self.left_by, self.lines = self._read()
            if not locked and self.left_by is not None and self.left_by.may_run():
                raise in_use(output, self.left_by, path)
        except BaseException:
            os.close(self._file)
            raise

    def _read(self) -> tuple[Holder | None, list[bytes]]:
        """What a killed process left, if there is anything."""
        with open(self._file, "rb", closefd=False) as stream:
            text = stream.read()
        note, *lines = text.split(b"\n")
        left_by = Holder.read(note)
        if text and left_by is None:
            raise UserError(
                f"{self.path}: is not a lock of this package\n    cause:  another program made a file of this name\n"
                "    remedy: choose another output, or move the file"
            )
        return left_by, [line for line in lines if line]

    def hold(self) -> None:
        """Replace what a killed process left by a note of this one."""
        try:
            os.ftruncate(self._file, 0)
            os.lseek(self._file, 0, os.SEEK_SET)
        except OSError as error:
            raise cannot_write(self.output, error) from error
        self.left_by, self.lines = None, []
        self.add(Holder.here().note())

    def add(self, line: bytes) -> None:
        """Add a line, which ends with a newline."""
        try:
            write_all(self._file, line)
        except OSError as error:
            raise cannot_write(self.output, error) from error

    def release(self, remove: bool = True) -> None:
        """Let others take the output."""
        if remove:
            with suppress(OSError):
                self.path.unlink(missing_ok=True)
        os.close(self._file)


def open_alone(path: Path) -> tuple[int, bool]:
    """Open or make a file that no other process has open through this function; False: the file system has no locks.

    Raises BlockingIOError if another process has it open, and other kinds of OSError.
    """
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
        try:
            locked = _lock(file)
            if _is_at(file, path):
                return file, locked
        except BaseException:
            os.close(file)
            raise
        os.close(file)  # its process renamed or removed it before this one had the lock


def write_all(file: int, content: bytes) -> None:
    """Write everything; where the disk fills up, the system first writes a part without an error."""
    rest = memoryview(content)
    while len(rest):
        rest = rest[os.write(file, rest) :]


def _lock(file: int) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        return False
    return True


def _is_at(file: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file), os.lstat(path))
    except FileNotFoundError:
        return False


def _holder(path: Path) -> Holder | None:
    try:
        with path.open("rb") as stream:
            return Holder.read(stream.readline())
    except OSError:
        return None


def in_use(output: Path, holder: Holder | None, note: Path | None = None) -> UserError:
    """The error for an output of another process; `note` is given if it cannot be known whether that still runs."""
    remedy = "wait until it has ended, or choose another output"
    if note is not None:
        remedy += f"; if it has ended, remove {note}"
    return UserError(
        f"{output}: is in use by {holder or 'another process'}\n    cause:  it is writing there\n    remedy: {remedy}"
    )
