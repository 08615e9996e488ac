"""Earlier runs with the same captures: the work folder that they filled, and the scans that may be renewed."""

import hashlib
import os
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.processing.cache import FOLDER
from sl_nerfstudio.processing.captures import Captures
from sl_nerfstudio.processing.config import ProcessConfig
from sl_nerfstudio.processing.records import read_note
from sl_nerfstudio.scan.write import encode_json
from sl_nerfstudio.storage import LOCK, NewFolder, files_below, held_by_another, write_atomic

# Which work folder a run uses: its own, or that of an earlier run with the same captures and another output. The user's
# cache folder has a note of which captures were processed in which work folder; the results stay where they are.

_NOTES = "work-folders.json"
_MOST_NOTED = 64  # folders of captures


def with_kept_work(config: ProcessConfig) -> ProcessConfig:
    """The configuration with the work folder of an earlier run of the same captures, unless it has one of its own."""
    if config.work is not None or os.path.lexists(config.work_folder):
        return config
    noted = _noted_work().get(os.path.realpath(config.images))
    if noted is None or not Path(noted, FOLDER).is_dir() or held_by_another(Path(noted)):
        return config
    return replace(config, work=Path(noted))


def note_work(config: ProcessConfig) -> None:
    """Let later runs with the same captures find the work folder, if there is a cache folder to note it in."""
    images = os.path.realpath(config.images)
    noted = {key: work for key, work in _noted_work().items() if key != images}
    noted[images] = os.path.realpath(config.work_folder)
    with suppress(UserError):
        write_atomic(_notes(), encode_json(dict(list(noted.items())[-_MOST_NOTED:])))


def _notes() -> Path:
    usual = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "sl-nerfstudio")
    return Path(os.environ.get("SL_CACHE") or usual, _NOTES)


def _noted_work() -> dict[str, str]:
    return {key: work for key, work in read_note(_notes()).items() if isinstance(work, str)}


# Scans that were made in a work folder. As long as one is as it was written, the same captures may renew it: everything
# that it was made from is still there.

_SCANS = "scans.json"


@dataclass(frozen=True)
class WrittenScan:
    """A scan as a run left it."""

    captures: str  # digest of the names and the contents of the captures
    files: dict[str, str]  # SHA-256 of each

    def require_same(self, captures: str, output: Path) -> None:
        """Raise UserError if the scan is one of other captures than those with this digest."""
        if captures != self.captures:
            raise UserError(
                f"{output}: holds the scan of other captures\n"
                "    cause:  photographs were added, removed or replaced since it was made\n"
                "    remedy: choose another output, or remove it first"
            )


def digest_of_captures(captures: Captures) -> str:
    """Digest of the names and the contents of all photographs."""
    found = hashlib.sha256()
    for frame in captures.frames:
        for path in frame.images:
            found.update(os.fsencode(f"{frame.name}/{path.name} {_digest(path)}\n"))
    return found.hexdigest()


def _digest(path: Path) -> str:
    """SHA-256 of a file; "" if it cannot be read."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return ""


def written_scan(config: ProcessConfig) -> WrittenScan | None:
    """The scan in the output, if a run with the same work folder made it; None if there is nothing known of it.

    Raises UserError if any file in it has been added, changed or removed since.
    """
    root = config.output
    record = read_note(config.work_folder / _SCANS).get(_place(config))
    if not isinstance(record, dict) or record.keys() != {"captures", "files"} or not root.is_dir():
        return None
    written, there = WrittenScan(**record), files_below(root)
    if not there:
        return None
    changed = set(there) ^ set(written.files)
    changed |= {name for name in set(there) - changed if _digest(root / name) != written.files[name]}
    if changed and os.path.lexists(root / LOCK):
        return None  # a run was killed while it renewed the scan: its list says what it leaves
    if changed:
        name = min(changed)
        what = "removed" if name not in there else "added" if name not in written.files else "changed"
        raise UserError(
            f"{root}: is not empty\n    cause:  it holds an earlier scan, and {name} was {what} since that was made\n"
            "    remedy: choose another output, or remove it first"
        )
    return written


def note_scan(config: ProcessConfig, folder: NewFolder, captures: str) -> None:
    """Note what was written to the output, so that the next run of the same captures may renew it."""
    path = config.work_folder / _SCANS
    scans = {place: scan for place, scan in read_note(path).items() if os.path.isdir(config.work_folder / place)}
    scans[_place(config)] = asdict(WrittenScan(captures, folder.digests))
    write_atomic(path, encode_json(scans))


def _place(config: ProcessConfig) -> str:
    """Where the output lies, seen from the work folder: both may be moved together."""
    return os.path.relpath(os.path.realpath(config.output), os.path.realpath(config.work_folder))
