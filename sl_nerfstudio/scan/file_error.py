"""The error of a file that cannot be used, and the reading of a whole file that raises it."""

import os
import stat
from pathlib import Path

from sl_nerfstudio.errors import UserError

MAX_FILE_BYTES = 4 << 30  # no picture or coordinate file of a scan comes near it


class FileError(UserError):
    """A file that cannot be used: problem, likely cause and remedy apart, so that a check can list them."""

    def __init__(self, path: Path, problem: str, cause: str, remedy: str) -> None:
        """All four in plain words; `problem` continues a sentence that starts with the file's name."""
        super().__init__(f"{path}: {problem}\n    cause:  {cause}\n    remedy: {remedy}")
        self.path, self.problem, self.cause, self.remedy = path, problem, cause, remedy


def check_file(path: Path) -> int:
    """Size in bytes of a regular file that is not empty. Raises FileError for anything else."""
    try:
        status = os.stat(path)
    except FileNotFoundError as error:
        raise FileError(
            path, "is missing", "it was moved, renamed or never written; names differ in upper and lower case",
            "restore it or correct the path",
        ) from error  # fmt: skip
    except (OSError, ValueError) as error:
        raise FileError(path, f"cannot be opened ({error})", "a broken link or path", "correct the path") from error
    if not stat.S_ISREG(status.st_mode):
        raise FileError(path, "is not a file", "a folder, a device or a pipe stands there", "correct the path")
    if status.st_size == 0:
        raise FileError(
            path, "is empty (0 bytes)", "writing it was broken off, as by a full disk", "copy or export this file again"
        )
    if status.st_size > MAX_FILE_BYTES:
        raise FileError(
            path,
            f"is {status.st_size >> 30} GiB large",
            "not a file of a scan",
            "correct the path or write the file again",
        )
    return status.st_size


def read_bytes(path: Path) -> bytes:
    """The whole file. Raises FileError if it is missing, empty, not a regular file or not readable."""
    check_file(path)
    try:
        return path.read_bytes()
    except OSError as error:
        raise unreadable(path, error) from error


def unreadable(path: Path, error: OSError) -> FileError:
    """The FileError of a file that exists but that the system does not let us read."""
    return FileError(
        path,
        f"cannot be read ({error.strerror})",
        "missing rights or a failing disk",
        "give yourself the right to read it",
    )
