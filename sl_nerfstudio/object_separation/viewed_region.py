"""Where all cameras look at: the point that their axes pass nearest, and how far around it they see."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.object_separation.frame_points import DecodedFrame

_TOWARDS_POINTS = 1e-2  # weight of the points' middle against one axis; it decides where all axes are parallel


@dataclass(frozen=True)
class ViewedRegion:
    """A sphere that most frames see, and light, completely."""

    focus: Float64[ndarray, "3"]
    radius: float

    def contains(self, p_world: Float[ndarray, "n 3"]) -> Bool[ndarray, "n"]:
        """Whether points are in it."""
        return np.linalg.norm(p_world - self.focus, axis=-1) < self.radius


def viewed_region(frames: Sequence[DecodedFrame], p_world: Float[ndarray, "n 3"]) -> ViewedRegion:
    """From the poses and fields of view of all devices; `p_world` are points of all frames."""
    middle = np.median(p_world, axis=0)
    A, b = _TOWARDS_POINTS * np.eye(3), _TOWARDS_POINTS * middle
    for frame in frames:
        axis, origin = frame.T_world_camera[:3, 2], frame.T_world_camera[:3, 3]
        across = np.eye(3) - np.outer(axis, axis)
        A, b = A + across, b + across @ origin
    focus = np.linalg.solve(A, b)
    reach = [
        min(_reach(frame.camera, frame.T_world_camera, focus), _reach(frame.projector, frame.T_world_projector, focus))
        for frame in frames
    ]
    return ViewedRegion(focus, float(np.median(reach)))


def _reach(device: Device, T_world_device: Float[ndarray, "4 4"], focus: Float[ndarray, "3"]) -> float:
    """Half the width of what a device sees at the distance of the focus."""
    distance = float(np.linalg.norm(T_world_device[:3, 3] - focus))
    return distance * min(device.w / device.fl_x, device.h / device.fl_y) / 2
