"""pose_covariance.npz beside refined poses: the joint covariance of all poses and the intrinsics."""

import io
from pathlib import Path

import numpy as np

from sl_nerfstudio.bundle_adjustment.joint_covariance.covariance import JointCovariance
from sl_nerfstudio.bundle_adjustment.self_calibration import UNKNOWNS
from sl_nerfstudio.files.atomic import write_atomic
from sl_nerfstudio.scan import FileError, Scan
from sl_nerfstudio.scan.coordinates import ARRAY_DAMAGE

COVARIANCE = "pose_covariance.npz"
_AGAIN = "export again with sl-export --poses"


def write_covariance(folder: Path, scan: Scan, joint: JointCovariance | None) -> None:
    """Write the file, in the scan's world and unit; with None, remove that of an earlier export."""
    path = folder / COVARIANCE
    if joint is None:
        path.unlink(missing_ok=True)
        return
    buffer = io.BytesIO()
    names = np.array([frame.name for frame in scan.frames])
    np.savez_compressed(buffer, factor=joint.factor, frames=names, units=np.array(scan.units))
    write_atomic(path, buffer.getvalue())


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
