"""The work folder: results of stages that the next run takes up, held by one run at a time."""

import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar
from zipfile import BadZipFile

from sl_nerfstudio.bundle_adjustment.modes import Mode
from sl_nerfstudio.bundle_adjustment.parameters import SelfCalibration
from sl_nerfstudio.bundle_adjustment.registered_frames import AdjustedFrames
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.processing.consistency import ConsistentFrames
from sl_nerfstudio.processing.records import DECODED, KEY_LENGTH, decode, digest, encode
from sl_nerfstudio.registration import result
from sl_nerfstudio.registration.static_projector import NoPlacement, StaticPlacement
from sl_nerfstudio.relative_pose.estimation import Degeneracy, RelativePose
from sl_nerfstudio.relative_pose.intrinsics import DeviceEvidence, IntrinsicsEvidence
from sl_nerfstudio.relative_pose.unknown_projector import NoProjector, ProjectorEstimate
from sl_nerfstudio.review.agreement import CrossFrameAgreement, FrameCrossAgreement, PairAgreement
from sl_nerfstudio.scan.types import PoseSigma
from sl_nerfstudio.storage import locked, read_checked, remove_partial, write_checked

T = TypeVar("T")

VERSIONS = {
    "size of photographs": 1,  # decoding/grid.py, `shrink_factor`
    "matching": 2,  # along epipolar lines: matching/
    "calibration": 1,  # the relative pose of a frame: relative_pose/ without the two below
    "projector": 1,  # estimated intrinsics: relative_pose/unknown_projector.py
    "test of intrinsics": 1,  # relative_pose/intrinsics.py
    "static projector": 1,  # registration/static_projector.py
    "registration": 7,  # registration/
    "adjustment": 10,  # processing/consistency.py, bundle_adjustment/, review/agreement.py
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
