"""Names of the files beside an output, and the error for a place where nothing can be written."""

import hashlib
import os
import re
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from sl_nerfstudio.errors import UserError

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


def require_possible(path: Path) -> None:
    """Raise UserError for a path in an existing folder that can neither be found nor made: its name is too long."""
    try:
        os.lstat(path)
    except FileNotFoundError:
        pass
    except OSError as error:
        raise cannot_write(path, error) from error


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
