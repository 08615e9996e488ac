"""Frames that ended farther from their starting poses than these were stated to be off."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.scan import Scan
from sl_nerfstudio.verdict.verdict import Reason

_MOST_SIGMA = 6.0  # for each axis, RMS: by chance less than once in 10^20 frames


@dataclass(frozen=True)
class DepartedFrame:
    """A frame whose starting pose and result exclude each other: one of them is wrong."""

    name: str
    turned_deg: float  # of the camera, from its starting pose
    stated_deg: float  # 1 sigma of that, about each axis


def departed_frames(scan: Scan, poses: DevicePoses) -> list[DepartedFrame]:
    """Frames whose cameras are turned by far more than the stated uncertainty of their starts.

    Positions are not compared: they depend on turns by as much as the camera is away from what it sees.
    """
    turned = _turned_deg(scan.poses.T_world_camera, poses.T_world_camera)
    stated = [None if f.pose_sigma is None else f.pose_sigma.camera_rotation_deg for f in scan.frames]
    return [
        DepartedFrame(frame.name, float(angle), sigma)
        for frame, angle, sigma in zip(scan.frames, turned, stated, strict=True)
        if sigma is not None and angle > _MOST_SIGMA * np.sqrt(3) * sigma
    ]


def describe_departed(found: Sequence[DepartedFrame]) -> str:
    """Each frame in a few words."""
    return ", ".join(f"{one.name} ({one.turned_deg:.1f} deg, stated {one.stated_deg:.2g})" for one in found)


def departed_reasons(found: Sequence[DepartedFrame]) -> list[Reason]:
    """A result that excludes what it started from is not good, whichever of them is wrong."""
    return [
        Reason("acceptable", f"{describe_departed([one])}: far from its starting pose; look at it") for one in found
    ]


def _turned_deg(a: Float64[ndarray, "n 4 4"], b: Float64[ndarray, "n 4 4"]) -> Float64[ndarray, "n"]:
    return np.degrees(Rotation.from_matrix(a[:, :3, :3].transpose(0, 2, 1) @ b[:, :3, :3]).magnitude())
