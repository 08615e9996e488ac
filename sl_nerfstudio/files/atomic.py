"""Files that appear complete or not at all."""

import os
from contextlib import suppress
from pathlib import Path

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.files.lock_file import in_use, open_alone, write_all
from sl_nerfstudio.files.paths import beside, cannot_write, is_beside

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
        path.parent.mkdir(parents=True, exist_ok=True)
        file, _ = open_alone(temporary)
    except BlockingIOError:
        raise in_use(path, None) from None
    except OSError as error:
        raise cannot_write(path, error) from error
    # The file stays open, and thereby locked, until it has its name: nobody else can then write into it.
    try:
        os.ftruncate(file, 0)
        write_all(file, content)
        temporary.replace(path)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise cannot_write(path, error) from error
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
    raise UserError(f"{root}: {problem}\n    cause:  {cause}\n    remedy: choose another output, or remove it first")
