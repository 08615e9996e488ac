"""Trajectories in the text formats of the TUM RGB-D and KITTI odometry benchmarks, which evo and others read."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from sl_nerfstudio.runs.cameras.posed_device import PosedDevice


def encode_tum(devices: Sequence[PosedDevice], placed: Sequence[bool], unit_m: float) -> bytes:
    """A line `timestamp tx ty tz qx qy qz qw` for each frame that is placed; the timestamp is its number, from 0.

    Poses are device to world, the device looking along its +z with +y down. Lengths are multiplied by `unit_m`.
    """
    lines = ["# timestamp tx ty tz qx qy qz qw (device to world; the timestamp is the number of the frame)"]
    for number, (device, good) in enumerate(zip(devices, placed, strict=True)):
        if good:
            T = device.T_world_cv
            values = [*(T[:3, 3] * unit_m), *Rotation.from_matrix(T[:3, :3]).as_quat()]
            lines.append(" ".join([f"{number:.6f}", *map(_text, values)]))
    return ("\n".join(lines) + "\n").encode()


def encode_kitti(devices: Sequence[PosedDevice], unit_m: float) -> bytes:
    """A line for every frame: the first three rows of its pose, device to world, axes and unit as for TUM.

    Lines are numbered as frames are, so frames that are not placed are among them.
    """
    poses = [np.concatenate([d.T_world_cv[:3, :3], d.T_world_cv[:3, 3:] * unit_m], 1) for d in devices]
    return ("\n".join(" ".join(map(_text, T.ravel())) for T in poses) + "\n").encode()


def _text(value: float) -> str:
    return f"{value:.12g}"
