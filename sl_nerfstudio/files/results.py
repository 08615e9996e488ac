"""Files that a command writes again and again, such as a report: only its own earlier ones are replaced."""

import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.files.lock import locked_file

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
    raise UserError(f"{path}: {problem}\n    cause:  {cause}\n    remedy: choose another output, or remove it first")
