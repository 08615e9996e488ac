"""Outlines of cameras and projectors, for pictures of a scene."""

import numpy as np
import torch
from jaxtyping import Float64, Int64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device, Intrinsics, unproject

_MARK_WIDTH, _MARK_HEIGHT = 0.25, 0.3  # of the mark above the upper edge, as shares of the image's width and height

OUTLINE: Int64[ndarray, "14"] = np.array([0, 1, 2, 0, 3, 4, 0, 4, 1, 5, 7, 6, 2, 3])
"""Indices into the points of `frustum`: one line that draws all edges of the pyramid and the mark."""


def frustum(device: Device, T_world_device: Float64[ndarray, "4 4"], length: float) -> Float64[ndarray, "8 3"]:
    """Points of a pyramid in world axes.

    The centre of projection; the image's corners, each at `length` along its own ray, clockwise from the upper left as
    the device sees it; and three points of a mark above the upper edge: on its left, on its right, and its tip.
    """
    w, h = float(device.w), float(device.h)
    uv = [[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]]
    rays = unproject(Intrinsics.of(device, torch.float64), torch.tensor(uv, dtype=torch.float64)).numpy()
    corners = np.concatenate([np.zeros((1, 3)), length * rays])
    left, right = (corners[1] + (0.5 + side * _MARK_WIDTH) * (corners[2] - corners[1]) for side in (-0.5, 0.5))
    tip = (left + right) / 2 + _MARK_HEIGHT * (corners[1] - corners[4])
    points = np.concatenate([corners, [left, right, tip]])
    return points @ T_world_device[:3, :3].T + T_world_device[:3, 3]
