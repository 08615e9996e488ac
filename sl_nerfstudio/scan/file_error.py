"""The error for a file that cannot be used, and the functions that open files and raise it."""

import os
import stat
from pathlib import Path

from sl_nerfstudio.errors import UserError

MAX_FILE_BYTES = 4 << 30  # far larger than any image or coordinate file of a scan


class FileError(UserError):
    """A file that cannot be used; problem, likely cause and remedy are separate, so that a check can list them."""

    def __init__(self, path: Path, problem: str, cause: str, remedy: str) -> None:
        """All in plain words; `problem` continues a sentence that starts with the file's name."""
        super().__init__(f"{path}: {problem}\n    cause:  {cause}\n    remedy: {remedy}")
        self.path, self.problem, self.cause, self.remedy = path, problem, cause, remedy


def check_file(path: Path) -> int:
    """Size in bytes of a regular file that is not empty. Raises FileError for anything else."""
    try:
        status = os.stat(path)
    except FileNotFoundError as error:
        raise FileError(
            path, "is missing", "it was moved, renamed or never written, or its name differs in upper and lower case",
            "restore it or correct the path",
        ) from error  # fmt: skip
    except (OSError, ValueError) as error:
        raise FileError(path, f"cannot be opened ({error})", "a broken link or path", "correct the path") from error
    if not stat.S_ISREG(status.st_mode):
        raise FileError(path, "is not a file", "there is a folder, a device or a pipe", "correct the path")
    if status.st_size == 0:
        raise FileError(
            path,
            "is empty (0 bytes)",
            "writing it was interrupted, for example by a full disk",
            "copy or export this file again",
        )
    if status.st_size > MAX_FILE_BYTES:
        raise FileError(
            path,
            f"is {status.st_size >> 30} GiB large",
            "it is not a file of a scan",
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
    """The FileError for a file that exists but cannot be opened."""
    return FileError(
        path,
        f"cannot be read ({error.strerror})",
        "missing permissions or a failing disk",
        "change its permissions, or copy it from a backup",
    )
