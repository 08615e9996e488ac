"""Frames that ended farther from their starting poses than these were stated to be off."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.similarity import angle_deg
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
    found = []
    for frame, T_start, T_end in zip(scan.frames, scan.poses.T_world_camera, poses.T_world_camera, strict=True):
        if frame.pose_sigma is None:
            continue
        turned, stated = angle_deg(T_start[:3, :3].T @ T_end[:3, :3]), frame.pose_sigma.camera_rotation_deg
        if turned > _MOST_SIGMA * np.sqrt(3) * stated:
            found.append(DepartedFrame(frame.name, turned, stated))
    return found


def describe_departed(found: Sequence[DepartedFrame]) -> str:
    """Each frame in a few words."""
    return ", ".join(f"{one.name} ({one.turned_deg:.1f} deg, stated {one.stated_deg:.2g})" for one in found)


def departed_reasons(found: Sequence[DepartedFrame]) -> list[Reason]:
    """A result that excludes what it started from is not good, whichever of them is wrong."""
    return [
        Reason("acceptable", f"{describe_departed([one])}: far from its starting pose; look at it") for one in found
    ]
