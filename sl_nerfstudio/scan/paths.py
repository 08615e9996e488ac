"""Paths in transforms.json: relative, and inside the folder even after links are followed."""

import os
from pathlib import Path, PureWindowsPath

from sl_nerfstudio.scan.fields import Fields
from sl_nerfstudio.scan.problem import Problem


def read_path(fields: Fields, key: str, root: Path) -> Path | None:
    """The absolute path under `key`, inside `root`; None after adding a fault."""
    text = fields.read_text(key)
    if text is None:
        return None
    path = resolve_inside(root, text)
    if isinstance(path, Path):
        return path
    fields.faults.add(path, fields.file, fields.frame, fields.prefix + key)
    return None


def resolve_inside(root: Path, text: str) -> Path | Problem:
    """Absolute path of `text` below `root`, or why it must not be used. The file itself need not exist.

    The returned path keeps links inside the folder as they are; it is not resolved.
    """
    windows = PureWindowsPath(text)
    if "\0" in text or _not_encodable(text):
        return Problem("contains characters that no file name can have", "the text is damaged", "correct the path")
    if text.startswith("/") or windows.drive:
        return Problem(
            f"is absolute ({text})",
            "it is valid on one machine only",
            "give the path relative to the scan folder",
        )
    if ".." in windows.parts:
        return Problem(
            f"leaves the scan folder ({text})",
            "the files are elsewhere, or the folder was made to read other people's files",
            "put the files inside the folder and give the path without '..'",
        )
    path = root / text
    if "\\" in text and not path.exists():
        return Problem(f"has backslashes ({text})", "it was written on Windows", "use / between folders")
    try:
        real, real_root = os.path.realpath(path, strict=True), os.path.realpath(root)
    except FileNotFoundError:
        return path  # reading it says that it is missing
    except OSError as error:
        return Problem(
            f"cannot be followed ({text}: {error.strerror})",
            "a link to itself, a file where a folder should be, or missing permissions",
            "put the file itself there",
        )
    if os.path.commonpath([real, real_root]) != real_root:
        return Problem(
            f"is a link out of the scan folder ({text})",
            "the files are elsewhere and were linked instead of copied",
            "copy the files into the folder",
        )
    return path


def _not_encodable(text: str) -> bool:
    try:
        os.fsencode(text)
    except UnicodeEncodeError:
        return True
    return False
