"""The work folder: one run at a time works in it, and no temporary file stays."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sl_nerfstudio.files.atomic import remove_partial
from sl_nerfstudio.files.lock import locked
from sl_nerfstudio.processing.kept.stages import FOLDER
from sl_nerfstudio.processing.kept.store import DECODED


@contextmanager
def work_folder(root: Path) -> Iterator[None]:
    """Hold the work folder; workers that were killed leave temporary files, which are removed before and after.

    Raises UserError if another process works in it, or if it cannot be written to.
    """
    with locked(root):
        _tidy(root)
        try:
            yield
        finally:
            _tidy(root)


def _tidy(root: Path) -> None:
    for folder in (root, root / DECODED, root / FOLDER):
        remove_partial(folder)
