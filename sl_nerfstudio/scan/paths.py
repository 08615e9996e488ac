"""Paths in transforms.json: relative, and inside the folder even after links are followed."""

import os
from pathlib import Path, PureWindowsPath

from sl_nerfstudio.scan.problem import Problem


def resolve_inside(root: Path, text: str) -> Path | Problem:
    """Absolute path of `text` below `root`, or why it may not be used. The file itself need not exist.

    The returned path keeps links inside the folder as they are; it is not resolved.
    """
    windows = PureWindowsPath(text)
    if "\0" in text or _not_encodable(text):
        return Problem("holds characters that no file name has", "a damaged text", "correct the path")
    if text.startswith("/") or windows.drive:
        return Problem(
            f"is absolute ({text})",
            "it was written on one machine for that machine",
            "give the path relative to the scan folder",
        )
    if ".." in windows.parts:
        return Problem(
            f"leaves the scan folder ({text})",
            "the files lie elsewhere, or the folder was made to read others' files",
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
            "a link that leads to itself, a file where a folder should be, or missing rights",
            "put the file itself there",
        )
    if os.path.commonpath([real, real_root]) != real_root:
        return Problem(
            f"is a link out of the scan folder ({text})",
            "the files lie elsewhere and were linked instead of copied",
            "copy the files into the folder",
        )
    return path


def _not_encodable(text: str) -> bool:
    try:
        os.fsencode(text)
    except UnicodeEncodeError:
        return True
    return False
