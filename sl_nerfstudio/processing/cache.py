"""The work folder: one run at a time works in it, and no temporary file stays."""

import hashlib
import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar
from zipfile import BadZipFile

import sl_nerfstudio
from sl_nerfstudio.bundle_adjustment.parameters import SelfCalibration
from sl_nerfstudio.bundle_adjustment.registered_frames import AdjustedFrames
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.processing.consistency import ConsistentFrames
from sl_nerfstudio.processing.records import DECODED, decode, digest, encode
from sl_nerfstudio.registration import result
from sl_nerfstudio.registration.static_projector import NoPlacement, StaticPlacement
from sl_nerfstudio.relative_pose.estimation import Degeneracy, RelativePose
from sl_nerfstudio.relative_pose.intrinsics import DeviceEvidence, IntrinsicsEvidence
from sl_nerfstudio.relative_pose.unknown_projector import NoProjector, ProjectorEstimate
from sl_nerfstudio.review.agreement import CrossFrameAgreement, FrameCrossAgreement, PairAgreement
from sl_nerfstudio.scan.types import PoseSigma
from sl_nerfstudio.storage import locked, read_checked, remove_partial, write_checked

# Results of stages, kept in the work folder: a file for each, with a digest of everything that it follows from.

T = TypeVar("T")

KEPT: tuple[type, ...] = (
    result.Registration, result.Edge, result.SurfaceDisagrees, result.NoCommonSurface, result.SeparateComponent,
    result.PoorPair, result.PairsContradict, result.CoordinatesDisagree, result.UndecidedProjector,
    result.UncertainRotation, result.SeparatePoses,
    ConsistentFrames, AdjustedFrames, DevicePoses, PoseSigma, SelfCalibration,
    Device, ProjectorEstimate, NoProjector, StaticPlacement, NoPlacement, IntrinsicsEvidence,
    DeviceEvidence,
    CrossFrameAgreement, FrameCrossAgreement, PairAgreement, RelativePose, Degeneracy,
)  # fmt: skip
"""The dataclasses that results of stages consist of."""

_PACKAGES = ("numpy", "scipy", "torch", "numba")  # the results may differ in the last digit with other versions
FOLDER = "stages"
_KEY_LENGTH = 24


class StageStore:
    """Results of stages in a work folder."""

    def __init__(self, work: Path, log: Callable[[str], None] = lambda _: None) -> None:
        """`log` gets a line for every result that is taken from an earlier run."""
        self._folder, self._log = work / FOLDER, log

    def kept(self, stage: str, inputs: object, compute: Callable[[], T]) -> T:
        """The result of `compute`, or of an earlier run from equal `inputs`, by the same code.

        Both are exactly the same: a result is returned as it will be read. `inputs` and the result are dataclasses,
        tuples, arrays and plain values; the result's dataclasses are among `KEPT`.
        """
        key = digest((surroundings(), inputs))
        path = self._folder / f"{stage}-{key[:_KEY_LENGTH]}.npz"
        stored = _stored(path)
        if stored is not None and stored[0] == key:
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


@cache
def surroundings() -> str:
    """A digest of the code of this package, of the packages that compute, and of the kind of machine."""
    root = Path(sl_nerfstudio.__file__).parent
    found = hashlib.sha256(f"{platform.machine()} {platform.python_version()}".encode())
    for name in _PACKAGES:
        found.update(f"{name} {version(name)} ".encode())
    for path in sorted(root.rglob("*.py")):
        found.update(str(path.relative_to(root)).encode() + hashlib.sha256(path.read_bytes()).digest())
    return found.hexdigest()


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
