"""The folder of a run: one process at a time writes to it, and nothing that is there is overwritten."""

import os
import shlex
import sys
from contextlib import suppress
from pathlib import Path

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.files.lock_file import open_alone, write_all
from sl_nerfstudio.model.training.checkpoints import checkpoints_in

LOCK, PARTIAL = ".lock", ".checkpoint.partial"
CONFIG = "config.yml"


class RunFolder:
    """A folder that this process has for itself until `leave`, or until it ends, however it ends."""

    def __init__(self, path: Path) -> None:
        """Make and take the folder. Raises UserError if another process has it, or if it cannot be written."""
        self.path = path
        try:
            path.mkdir(parents=True, exist_ok=True)
            self._lock, locked = open_alone(path / LOCK)
            os.ftruncate(self._lock, 0)
            write_all(self._lock, str(os.getpid()).encode())
        except BlockingIOError as error:
            raise UserError(
                f"{path}: another ns-train is writing there (process {_number_in(path / LOCK)})\n"
                "    cause:  two trainings were started with the same --output-dir, --experiment-name and --timestamp\n"
                "    remedy: wait until it has ended, or choose another --timestamp"
            ) from error
        except OSError as error:
            raise UserError(
                f"{path}: cannot be written ({error.strerror})\n"
                "    cause:  missing permissions, a read-only disk, or a file where a folder is needed\n"
                "    remedy: choose another place with --output-dir"
            ) from error
        if not locked:
            print(f"note: {path} is on a disk that knows no locks; start no second run there", file=sys.stderr)
        with suppress(OSError):
            (path / PARTIAL).unlink()  # left by a process that was killed while it wrote

    def leave(self) -> None:
        """Let other processes have the folder."""
        os.close(self._lock)


def _number_in(lock: Path) -> str:
    with suppress(OSError):
        return lock.read_bytes()[:20].decode("ascii", "replace") or "unknown"
    return "unknown"


def require_unused(folder: Path, models: Path, method: str) -> None:
    """Raise UserError if another run was begun in `folder`; `models` is where its checkpoints are."""
    try:
        found = sorted(path.name for path in folder.iterdir() if path.name not in (LOCK, PARTIAL))
    except FileNotFoundError:
        return
    except OSError as error:
        raise UserError(
            f"{folder}: cannot be read ({error.strerror})\n    remedy: choose another --timestamp"
        ) from error
    if not found:
        return
    if CONFIG not in found:
        raise UserError(
            f"{folder}: is not empty (it holds {found[0]})\n    cause:  the folder is used for something else\n"
            "    remedy: choose another --timestamp, --experiment-name or --output-dir"
        )
    saved = checkpoints_in(models)
    state = f"its last checkpoint is {saved[-1].name}" if saved else "it has no checkpoint yet"
    remedies = [f"to finish that run if it was interrupted: {go_on_command(method, folder)}"]
    if saved:
        remedies.append(f"to train it further: add --load-dir {shlex.quote(str(models))}")
    raise UserError(
        f"{folder}: holds another run ({state}), and nothing was changed\n"
        "    cause:  --output-dir, --experiment-name and --timestamp name the folder of an earlier run\n"
        "    remedy: choose another name with --timestamp; " + "\n            ".join(["or", *remedies])
    )


def go_on_command(method: str, folder: Path) -> str:
    """The command that continues a run up to the length that it was started with."""
    return f"ns-train {method} --load-config {shlex.quote(str(folder / CONFIG))}"
