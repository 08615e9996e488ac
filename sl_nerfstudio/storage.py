"""What is written to disk: outputs of one process alone, complete or not there at all; and arrays too large for memory.

filelock is not used: it empties the file that it locks, and so the note of what a killed process had written; it leaves
its file in the user's folder; and it refuses file systems without locks.
"""

import errno
import fcntl
import hashlib
import json
import math
import os
import re
import socket
import sys
import tempfile
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from io import BytesIO
from pathlib import Path, PurePosixPath
from typing import IO

import numpy as np
from numpy import ndarray

from sl_nerfstudio.errors import UserError

# Names of the files beside an output, and the error for a place where nothing can be written.

_DIGITS = 16  # of a name's digest


def beside(path: Path, ending: str) -> Path:
    """A hidden file next to `path` that belongs to it: the same one in every process, and never too long a name."""
    return path.parent / f".{hashlib.sha256(os.fsencode(path.name)).hexdigest()[:_DIGITS]}.{ending}"


def is_beside(name: str, ending: str) -> bool:
    """Whether `beside` makes such names."""
    return re.fullmatch(rf"\.[0-9a-f]{{{_DIGITS}}}\.{ending}", name) is not None


def cannot_write(path: Path, error: OSError) -> UserError:
    """The error for an output that the system does not let us write."""
    return UserError(
        f"{path}: cannot be written ({error.strerror})\n"
        "    cause:  the disk is full, the folder is read-only, or there is a file where a folder is needed\n"
        "    remedy: free some space, or choose another output"
    )


def _already_there(path: Path, problem: str, cause: str) -> UserError:
    """The error for an output that cannot be written because of what is there."""
    return UserError(f"{path}: {problem}\n    cause:  {cause}\n    remedy: choose another output, or remove it first")


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Errors of the system in the block are those of an output that cannot be written."""
    try:
        yield
    except BlockingIOError:
        raise
    except OSError as error:
        raise cannot_write(path, error) from error


def require_possible(path: Path) -> None:
    """Raise UserError for a path in an existing folder that can neither be found nor made: its name is too long."""
    with _writing(path), suppress(FileNotFoundError):
        os.lstat(path)


def made_with(folder: Path) -> list[Path]:
    """`folder` and those above it that do not exist yet, the innermost first; all are made now, or none.

    Raises UserError if they cannot be made.
    """
    missing: list[Path] = []
    try:
        missing = [p for p in (folder, *folder.parents) if not p.exists()]
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        remove_empty(missing)
        raise cannot_write(folder, error) from error
    return missing


def remove_empty(folders: Iterable[Path]) -> None:
    """Remove those folders that are empty, in the order given."""
    for folder in folders:
        with suppress(OSError):  # not empty, or not there
            folder.rmdir()


# A file that one process holds, with a note of which process that is.
#
# The kernel releases the file when its process ends, however it ends (flock), so one that a killed process left blocks
# nobody. Where a file system knows no locks, the note decides.

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
        """Read a note; None if the text is none."""
        try:
            found = json.loads(note)["sl-nerfstudio"]
            return Holder(str(found["command"]), int(found["process"]), str(found["host"]), str(found["since"]))
        except (ValueError, KeyError, TypeError, RecursionError):
            return None

    def note(self) -> bytes:
        """Write the note: one line of text."""
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
        """Describe the process in words."""
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
            with _writing(output):
                self._file, locked = open_alone(path)
        except BlockingIOError:
            raise in_use(output, _holder(path)) from None
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
        with _writing(self.output):
            os.ftruncate(self._file, 0)
            os.lseek(self._file, 0, os.SEEK_SET)
        self.left_by, self.lines = None, []
        self.add(Holder.here().note())

    def add(self, line: bytes) -> None:
        """Add a line, which ends with a newline."""
        with _writing(self.output):
            write_all(self._file, line)

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
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(file), os.lstat(path)):
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
    except OSError as error:
        if error.errno not in _NO_LOCKS:  # held by another process, among others
            raise
        return False
    return True


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


# Outputs of one process alone: a second one on the same folder or file is refused.

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


def held_by_another(folder: Path) -> bool:
    """Whether another process holds a folder, or it cannot be known."""
    try:
        if os.path.lexists(folder / LOCK):
            os.close(open_alone(folder / LOCK)[0])
    except OSError:
        return True
    return not os.access(folder, os.W_OK)


@contextmanager
def locked_file(path: Path) -> Iterator[None]:
    """Hold one file; others in its folder may be outputs of other processes."""
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


# Files that appear complete or not at all.

PARTIAL = "partial"
"""Ending of the temporary files."""


def write_atomic(path: Path, content: bytes) -> None:
    """Write `content` to a hidden temporary file next to `path`, then rename it to `path`.

    Missing folders are made. The temporary file has the same name every time, so one that a killed process left is
    replaced. Raises UserError if the disk is full, if writing is not allowed, or if another process is writing the same
    file; `path` is then unchanged.
    """
    temporary = beside(path, PARTIAL)
    try:
        with _writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            file, _ = open_alone(temporary)
    except BlockingIOError:
        raise in_use(path, None) from None
    # The file stays open, and thereby locked, until it has its name: nobody else can then write into it.
    try:
        with _writing(path):
            os.ftruncate(file, 0)
            write_all(file, content)
            temporary.replace(path)
    except BaseException:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise
    finally:
        os.close(file)


def remove_partial(folder: Path) -> None:
    """Remove the temporary files in a folder (not below it) to which no other process is writing."""
    with suppress(FileNotFoundError):
        for path in folder.iterdir():
            if is_beside(path.name, PARTIAL):
                with suppress(OSError):
                    path.unlink()


def files_below(root: Path) -> list[str]:
    """All files in a folder and below it but its lock, with / between folders."""
    found = (Path(folder, name) for folder, _, names in os.walk(root) for name in names)
    return sorted(path.relative_to(root).as_posix() for path in found if path != root / LOCK)


def require_empty(root: Path) -> None:
    """Raise UserError unless `root` can become a new folder: it does not exist, or is an empty folder."""
    try:
        if root.is_dir() and any(root.iterdir()):
            problem, cause = "is not empty", "it holds an earlier result"
        elif root.exists() and not root.is_dir():
            problem, cause = "is a file", "the output must be a folder"
        else:
            return
    except OSError as error:
        problem, cause = f"cannot be read ({error.strerror})", "missing permissions"
    raise _already_there(root, problem, cause)


# Files that are used only if they are whole: a digest of the content follows it.

_LENGTH = hashlib.sha256().digest_size


def write_checked(path: Path, content: bytes) -> None:
    """Write the content with its digest; the file appears complete or not at all. Raises UserError."""
    write_atomic(path, content + hashlib.sha256(content).digest())


def read_checked(path: Path) -> bytes | None:
    """The content; None if there is no such file, if it cannot be read, or if any byte of it has changed."""
    try:
        stored = path.read_bytes()
    except OSError:
        return None
    content, digest = stored[:-_LENGTH], stored[-_LENGTH:]
    return content if hashlib.sha256(content).digest() == digest else None


def encode_npz(arrays: Mapping[str, ndarray]) -> bytes:
    """An .npz file of arrays without objects, compressed as fast as can be: harder takes five times as long for 5 %."""
    buffer = BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)
    return buffer.getvalue()


# A new folder that is complete or not there at all, whatever ends the process that fills it.


class NewFolder:
    """Fills a new folder, alone. After an exception in its block, everything written is removed again.

    The lock in the folder lists the files before they are written, until the folder is complete. So what a killed
    process left can be told from files of the user: the next process that takes the folder removes it.

        with NewFolder(root) as folder:
            folder.write("images/a.png", ..)
            folder.write("transforms.json", .., last=True)
    """

    def __init__(self, root: Path, renews: Sequence[str] = ()) -> None:
        """Take the folder. Raises UserError if it holds anything else than what a killed process left, or is in use.

        `renews`: files of an earlier result, relative to the folder. They stay until the first new file is written, and
        are then removed, all of them.
        """
        self.root = root
        self.digests: dict[str, str] = {}
        """SHA-256 of every file that was written."""
        self._earlier = list(renews)
        if not os.path.lexists(root / LOCK) and not renews:
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
            foreign = _foreign(self.root, [*left, *self._earlier])
            if foreign is not None:
                killed, cause = self._lock.left_by, "it holds an earlier result"
                if killed is not None:
                    mine = foreign.relative_to(self.root)
                    cause = f"{killed} was killed before it had finished, and {mine} was not listed by it"
                raise _already_there(self.root, "is not empty", cause)
            left = [path for path in left if path not in self._earlier]  # of which nothing is gone yet
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
        for old in self._earlier:  # all listed before the first is gone: after a kill, the next process removes them
            self._lock.add(json.dumps(old).encode() + b"\n")
        _remove(self.root, self._earlier)
        self._earlier = []
        listed = beside(Path(path), PARTIAL).as_posix() if last else path
        self._lock.add(json.dumps(listed).encode() + b"\n")
        self.digests[path] = hashlib.sha256(content).hexdigest()
        write_atomic(self.root / path, content)

    def __enter__(self) -> "NewFolder":
        """The folder itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Let go of the folder; after an exception without what was written."""
        self.close(complete=kind is None)

    def close(self, complete: bool) -> None:
        """Let go of the folder, as at the end of the block; `complete`: keep what was written."""
        try:
            if not complete:
                _remove(self.root, list(self.digests))
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


# Files that a command writes again and again, such as a report: only its own earlier ones are replaced.

_LOOKED_AT = 4096  # bytes at the beginning of a file


@contextmanager
def held_results(marks: Mapping[Path, bytes]) -> Iterator[None]:
    """Hold files that are to be written; those that exist must be earlier results.

    `marks` has, for every file, a text that stands near its beginning. Raises UserError for any other existing file,
    for folders and devices, and if another process is writing one of them.
    """
    for path, mark in marks.items():
        _require_earlier_result(path, mark)
    with ExitStack() as held:
        for path in marks:
            held.enter_context(locked_file(path))
        yield


def _require_earlier_result(path: Path, mark: bytes) -> None:
    try:
        if not os.path.lexists(path):
            return
        if not path.is_file():
            problem, cause = "is not a file", "there is a folder, a device, a pipe or a broken link"
        else:
            with path.open("rb") as stream:
                begin = stream.read(_LOOKED_AT)
            if not begin or mark in begin:
                return
            problem, cause = "would be overwritten, and is no earlier result of this command", "a typing error"
    except OSError as error:
        problem, cause = f"cannot be read ({error.strerror})", "a name that is too long, or missing permissions"
    raise _already_there(path, problem, cause)


# Arrays that grow piece by piece, or are many: in memory, or in a temporary file once they are large.
#
# The file lies in the folder for temporary files (TMPDIR) and has no name: it is gone with the process, whatever ends
# it. The operating system keeps in memory what is used of it.

_ALIGNMENT = 64  # bytes, of arrays in a file
_SHARE = 8  # of the memory that this process may use, as a divisor: beyond it, an array goes to a file


def largest_in_memory() -> int:
    """Bytes beyond which an array is kept in a file."""
    from sl_nerfstudio.parallel import memory_of_process

    return memory_of_process() // _SHARE


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
            from sl_nerfstudio.parallel import return_freed_memory

            return_freed_memory()


def in_file(arrays: Sequence[ndarray]) -> list[ndarray]:
    """Map arrays into memory from one temporary file. Raises UserError if the disk is full."""
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
