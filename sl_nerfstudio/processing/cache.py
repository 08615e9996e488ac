"""The work folder, held by one run at a time: results of stages that the next run takes up, and scans it may renew."""

import hashlib
import os
import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar
from zipfile import BadZipFile

from sl_nerfstudio.bundle_adjustment.modes import Mode
from sl_nerfstudio.bundle_adjustment.parameters import SelfCalibration
from sl_nerfstudio.bundle_adjustment.registered_frames import AdjustedFrames
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.processing.captures import Captures
from sl_nerfstudio.processing.config import ProcessConfig
from sl_nerfstudio.processing.consistency import ConsistentFrames
from sl_nerfstudio.processing.records import DECODED, KEY_LENGTH, decode, digest, encode, read_note
from sl_nerfstudio.registration import result
from sl_nerfstudio.registration.static_projector import NoPlacement, StaticPlacement
from sl_nerfstudio.relative_pose.estimation import Degeneracy, RelativePose
from sl_nerfstudio.relative_pose.intrinsics import DeviceEvidence, IntrinsicsEvidence
from sl_nerfstudio.relative_pose.unknown_projector import NoProjector, ProjectorEstimate
from sl_nerfstudio.review.agreement import CrossFrameAgreement, FrameCrossAgreement, PairAgreement
from sl_nerfstudio.scan.types import PoseSigma
from sl_nerfstudio.scan.write import encode_json
from sl_nerfstudio.storage import (
    LOCK,
    NewFolder,
    files_below,
    held_by_another,
    locked,
    read_checked,
    remove_partial,
    write_atomic,
    write_checked,
)

T = TypeVar("T")

VERSIONS = {
    "size of photographs": 1,  # decoding/grid.py, `shrink_factor`
    "matching": 2,  # along epipolar lines: matching/
    "calibration": 1,  # the relative pose of a frame: relative_pose/ without the two below
    "projector": 1,  # estimated intrinsics: relative_pose/unknown_projector.py
    "test of intrinsics": 1,  # relative_pose/intrinsics.py
    "static projector": 1,  # registration/static_projector.py
    "registration": 9,  # registration/
    "adjustment": 13,  # processing/consistency.py, bundle_adjustment/, review/agreement.py
}
"""Number of each stage. Raise it whenever the stage, or anything that it calls, may give another result from the same
inputs: another algorithm, constant, order of summation or field of a result. Names, comments and speed need none.
Decoding has the `version` of its decoder instead."""

KEPT: tuple[type, ...] = (
    result.Registration, result.Edge, result.SurfaceDisagrees, result.NoCommonSurface, result.SeparateComponent,
    result.PoorPair, result.OpenPlace, result.CoordinatesDisagree, result.UndecidedProjector,
    result.UncertainRotation, result.SeparatePoses,
    ConsistentFrames, AdjustedFrames, Mode, DevicePoses, PoseSigma, SelfCalibration,
    Device, ProjectorEstimate, NoProjector, StaticPlacement, NoPlacement, IntrinsicsEvidence,
    DeviceEvidence,
    CrossFrameAgreement, FrameCrossAgreement, PairAgreement, RelativePose, Degeneracy,
)  # fmt: skip
"""The dataclasses that results of stages consist of."""

FOLDER = "stages"
_LIBRARIES = ("numpy", "scipy", "torch", "numba")  # other versions may differ in the last digit


def stage_key(stage: str, inputs: object) -> str:
    """Digest of everything that the result of a stage follows from: its version, its inputs, libraries and machine."""
    return digest((stage, VERSIONS[stage], _computer(), inputs))


@cache
def _computer() -> str:
    libraries = " ".join(f"{name} {version(name)}" for name in _LIBRARIES)
    return f"{platform.machine()} python {platform.python_version()} {libraries}"


class StageStore:
    """Results of stages in a work folder: one file for each, with its key."""

    def __init__(self, work: Path, log: Callable[[str], None] = lambda _: None) -> None:
        """`log` gets a line for every result that is taken from an earlier run."""
        self._folder, self._log = work / FOLDER, log

    def kept(self, stage: str, inputs: object, compute: Callable[[], T], frame: str = "") -> T:
        """Return the result of `compute`, or that of an earlier run with the same key.

        Both are exactly the same: a result is returned as it will be read. `inputs` and the result are dataclasses,
        tuples, arrays and plain values; the result's dataclasses are among `KEPT`. `frame` goes into the file's name.
        """
        key = stage_key(stage, inputs)
        path = self._folder / f"{' '.join(filter(None, (stage, frame)))}-{key[:KEY_LENGTH]}.npz"
        stored = _stored(path)
        if stored is not None and stored[0] == key:
            with suppress(OSError):
                path.touch()  # used: not among the oldest
            self._log(f"{stage}: kept from an earlier run")
            return stored[1]
        content = encode((key, compute()))
        write_checked(path, content)
        return decode(content, KEPT)[1]


def _stored(path: Path) -> tuple[Any, Any] | None:
    """Key and value of a file; None where it is missing, damaged, or holds something else."""
    content = read_checked(path)
    if content is None:
        return None
    try:
        key, value = decode(content, KEPT)
    except (KeyError, ValueError, TypeError, AttributeError, EOFError, RecursionError, BadZipFile):
        return None
    return key, value


@contextmanager
def work_folder(root: Path) -> Iterator[None]:
    """Hold the work folder; workers that were killed leave temporary files, which are removed before and after.

    Raises UserError if another process works in it, or if it cannot be written to.
    """
    folders = (root, root / DECODED, root / FOLDER)
    with locked(root):
        for folder in folders:
            remove_partial(folder)
        try:
            yield
        finally:
            for folder in folders:
                remove_partial(folder)
                _remove_oldest(folder)


MOST_KEPT = 16  # results of one stage, or of one frame: so many can be gone back to


def _remove_oldest(folder: Path) -> None:
    """Keep the results that were made or used last; those of one stage or frame differ by the key in their names."""
    alike: dict[str, list[Path]] = {}
    for path in folder.glob("*-*.npz"):
        alike.setdefault(path.name.rpartition("-")[0], []).append(path)
    for paths in alike.values():
        for path in sorted(paths, key=lambda path: path.stat().st_mtime_ns)[:-MOST_KEPT]:
            path.unlink(missing_ok=True)


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
