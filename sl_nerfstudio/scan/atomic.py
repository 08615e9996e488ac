"""Files that appear complete or not at all."""

from contextlib import suppress
from pathlib import Path
from uuid import uuid4

from sl_nerfstudio.errors import UserError


def write_atomic(path: Path, content: bytes) -> None:
    """Write `content` to a temporary file next to `path`, then rename it to `path`.

    Missing folders are made. Raises UserError if the disk is full or writing is not allowed; `path` is then unchanged.
    """
    temporary = path.parent / f".{uuid4().hex}.partial"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("xb") as stream:
            stream.write(content)
        temporary.replace(path)
    except OSError as error:
        raise UserError(
            f"{path}: cannot be written ({error.strerror})\n"
            "    cause:  the disk is full, the folder is read-only, or there is a file where a folder is needed\n"
            "    remedy: free some space, or choose another output"
        ) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


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
