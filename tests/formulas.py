"""The scan format's formulas for devices without distortion, written out in numpy; and errors of poses."""

from collections.abc import Sequence

import numpy as np
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.lie import Similarity, fit_similarity


def look_at(
    eye: Sequence[float] | ndarray,
    target: Sequence[float] | ndarray = (0.0, 0.0, 0.0),
    roll: float = 0.0,
    up: Sequence[float] = (0.0, 0.0, 1.0),
) -> ndarray:
    """Pose of a device at `eye` that looks along its -z at `target`, +y towards `up`, turned by `roll` radian."""
    back = np.subtract(eye, target).astype(float)
    back /= np.linalg.norm(back)
    right = np.cross(up if np.abs(back @ up) < 0.99 * np.linalg.norm(up) else (0.0, 1.0, 0.0), back)
    right /= np.linalg.norm(right)
    c, s = np.cos(roll), np.sin(roll)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(back, right), back], 1) @ [[c, -s, 0], [s, c, 0], [0, 0, 1]]
    T[:3, 3] = eye
    return T


def rays(device: Device, T: ndarray, uv: ndarray | None = None) -> tuple[ndarray, ndarray]:
    """Eye (3,) and unit directions (.., 3) through pixels (.., 2); by default through the centres of all, (h, w, 3)."""
    if uv is None:
        uv = np.stack(np.meshgrid(np.arange(device.w) + 0.5, np.arange(device.h) + 0.5), -1)
    x, y = (uv[..., 0] - device.cx) / device.fl_x, -(uv[..., 1] - device.cy) / device.fl_y
    d = np.stack([x, y, -np.ones_like(x)], -1)
    return T[:3, 3], d / np.linalg.norm(d, axis=-1, keepdims=True) @ T[:3, :3].T


def pixels(device: Device, T: ndarray, p_world: ndarray) -> ndarray:
    """Pixels (.., 2) of points (.., 3), also of points behind the device."""
    p = (p_world - T[:3, 3]) @ T[:3, :3]
    depth = np.linalg.norm(p, axis=-1) if device.model == "DOE" else -p[..., 2]
    return np.stack([device.fl_x * p[..., 0] / depth + device.cx, -device.fl_y * p[..., 1] / depth + device.cy], -1)


def on_ball(eye: ndarray, d: ndarray, radius: float) -> ndarray:
    """Where rays first meet a ball about the origin; NaN where they miss it."""
    along = d @ eye
    with np.errstate(invalid="ignore"):
        return eye + (-along - np.sqrt(along**2 - eye @ eye + radius**2))[..., None] * d


def pose_errors(found: ndarray, true: ndarray) -> tuple[Similarity, ndarray, ndarray]:
    """The similarity that moves poses best onto the true ones, and what is left: degrees, and lengths of the truth."""
    S = fit_similarity(found[:, :3, 3], true[:, :3, 3])
    left = S.poses(found)
    turn = Rotation.from_matrix(np.swapaxes(left[:, :3, :3], 1, 2) @ true[:, :3, :3]).magnitude()
    return S, np.degrees(turn), np.linalg.norm(left[:, :3, 3] - true[:, :3, 3], axis=1)
