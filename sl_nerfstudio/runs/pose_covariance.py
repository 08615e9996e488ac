"""pose_covariance.npz beside refined poses: the joint covariance of all poses and the intrinsics.

A file of its own, so that what reads it need not import nerfstudio, which the rest of `runs` does.
"""

from pathlib import Path

import numpy as np

from sl_nerfstudio.bundle_adjustment.covariance import JointCovariance
from sl_nerfstudio.bundle_adjustment.parameters import UNKNOWNS
from sl_nerfstudio.scan import FileError, Scan
from sl_nerfstudio.scan.coordinates import ARRAY_DAMAGE
from sl_nerfstudio.storage import encode_npz, write_atomic

COVARIANCE = "pose_covariance.npz"
_AGAIN = "export again with sl-export --poses"


def write_covariance(folder: Path, scan: Scan, joint: JointCovariance | None) -> None:
    """Write the file, in the scan's world and unit; with None, remove that of an earlier export."""
    path = folder / COVARIANCE
    if joint is None:
        path.unlink(missing_ok=True)
        return
    names = np.array([frame.name for frame in scan.frames])
    write_atomic(path, encode_npz({"factor": joint.factor, "frames": names, "units": np.array(scan.units)}))


def read_covariance(folder: Path, scan: Scan) -> JointCovariance | None:
    """The covariance in a folder of refined poses; None if there is none. Raises FileError for one that is not it."""
    path = folder / COVARIANCE
    if not path.exists():
        return None
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            factor, frames, units = archive["factor"], archive["frames"].tolist(), str(archive["units"])
    except (*ARRAY_DAMAGE, KeyError) as error:
        raise FileError(path, f"cannot be read ({error})", "it is damaged or another file", _AGAIN) from error
    if frames != [frame.name for frame in scan.frames] or units != scan.units:
        raise FileError(path, "is that of other frames or another unit", "the poses are those of another scan", _AGAIN)
    size = 12 * len(frames) + UNKNOWNS
    if factor.ndim != 2 or len(factor) != size or factor.dtype != np.float64 or not np.isfinite(factor).all():
        raise FileError(path, f"factor: is {factor.dtype} {factor.shape}", "the file is damaged", _AGAIN)
    return JointCovariance(factor)
