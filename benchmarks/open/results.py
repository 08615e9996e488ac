"""What a method hands in for one scan: mesh.ply, and poses as transforms.json or in the format of TUM's benchmark."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.scan.document import TRANSFORMS, frame_label, read_document

CAMERAS_TUM, PROJECTORS_TUM = "cameras.txt", "projectors.txt"
_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # its device axes to ours, on the right
_ORTHOGONAL = 1e-3  # largest departure of R R^T from the identity


@dataclass(frozen=True)
class HandedPoses:
    """Device-to-world poses by the frame's name, in the axes of the scan format; projectors may be missing."""

    camera: dict[str, Float64[ndarray, "4 4"]]
    projector: dict[str, Float64[ndarray, "4 4"]]


def read_handed_poses(folder: Path) -> HandedPoses | None:
    """The poses in a folder; None if it has neither file. Raises UserError for files that cannot be right."""
    if (folder / TRANSFORMS).exists():
        return _of_transforms(folder / TRANSFORMS)
    if (folder / CAMERAS_TUM).exists():
        path = folder / PROJECTORS_TUM
        return HandedPoses(_of_tum(folder / CAMERAS_TUM), _of_tum(path) if path.exists() else {})
    return None


def _of_transforms(path: Path) -> HandedPoses:
    document = read_document(path)
    frames = document.get("frames")
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise UserError(f"{path}: frames: is missing or is not a list of objects")
    found: list[dict[str, Float64[ndarray, "4 4"]]] = []
    for key in ("transform_matrix", "projector_transform_matrix"):
        labels = [(frame_label(frame, k), frame) for k, frame in enumerate(frames)]
        found.append({name: _pose(path, name, frame[key]) for name, frame in labels if frame.get(key) is not None})
    return HandedPoses(*found)


def _of_tum(path: Path) -> dict[str, Float64[ndarray, "4 4"]]:
    found = {}
    for number, line in enumerate(path.read_text().splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            tx, ty, tz, qx, qy, qz, qw = map(float, words[1:])
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = Rotation.from_quat([qx, qy, qz, qw]).as_matrix(), (tx, ty, tz)
        except ValueError as error:
            raise UserError(
                f"{path}: line {number}: is not NAME TX TY TZ QX QY QZ QW\n"
                "    remedy: one line for each frame: its name, the position, and a quaternion other than 0"
            ) from error
        found[words[0]] = T @ _OPENCV
    return found


def _pose(path: Path, name: str, value: object) -> Float64[ndarray, "4 4"]:
    try:
        T = np.array(value, dtype=np.float64)
        R = T[:3, :3]
        right = T.shape == (4, 4) and bool(np.abs(R @ R.T - np.eye(3)).max() < _ORTHOGONAL)
    except (ValueError, TypeError, IndexError):
        right = False
    if not right:
        raise UserError(f"{path}: {name}: is not a 4 x 4 pose\n    remedy: give rotation and translation, unscaled")
    return T
