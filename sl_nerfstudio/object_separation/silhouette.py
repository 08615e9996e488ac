"""The outline of the object in a frame, from the points of all frames."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.ndimage import binary_closing

from sl_nerfstudio.geometry.devices import Intrinsics, project
from sl_nerfstudio.object_separation.frame_points import DecodedFrame


def silhouette(frame: DecodedFrame, p_object: Float[ndarray, "n 3"], gap: float) -> Bool[ndarray, "h w"]:
    """Pixels of a frame in which points of the object are, hidden or not; gaps up to `gap` wide are closed."""
    h, w = frame.seen.shape
    inside = np.zeros((h, w), dtype=bool)
    p_camera = (p_object - frame.T_world_camera[:3, 3]) @ frame.T_world_camera[:3, :3]
    uv, in_front = project(Intrinsics.of(frame.camera, torch.float64), torch.from_numpy(p_camera))
    column, row = np.floor(uv.numpy() / frame.stride).T
    shown = in_front.numpy() & (row >= 0) & (row < h) & (column >= 0) & (column < w)
    inside[row[shown].astype(np.int64), column[shown].astype(np.int64)] = True
    if not shown.any():
        return inside
    depth = float(np.median(-p_camera[shown, 2]))
    steps = max(1, round(gap * frame.camera.fl_x / depth / frame.stride / 2))
    padded = np.pad(inside, steps)
    return binary_closing(padded, iterations=steps)[steps:-steps, steps:-steps]
