"""Files that are used only if they are whole: a digest of the content follows it."""

import hashlib
from pathlib import Path

from sl_nerfstudio.files.atomic import write_atomic

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
