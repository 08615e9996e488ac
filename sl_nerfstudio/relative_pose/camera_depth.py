"""Depth along camera rays from one pose of the projector, and how it changes with that pose."""

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.relative_pose.sampson import cross, direction_basis


def camera_depth(
    R: Float64[ndarray, "3 3"],
    t: Float64[ndarray, "3"],
    d_camera: Float64[ndarray, "n 3"],
    d_projector: Float64[ndarray, "n 3"],
) -> Float64[ndarray, "n"]:
    """Depth along camera rays where they come nearest to projector rays, each in its device's axes.

    `R`, `t` map from the projector to the camera.
    """
    d_p = d_projector @ R.T
    normal = np.cross(d_camera, d_p)
    return (np.cross(t, d_p) * normal).sum(-1) / (normal * normal).sum(-1).clip(1e-300)


def camera_depth_by_pose(
    R: Float64[ndarray, "3 3"],
    t: Float64[ndarray, "3"],
    d_camera: Float64[ndarray, "n 3"],
    d_projector: Float64[ndarray, "n 3"],
) -> Float64[ndarray, "n 5"]:
    """Derivatives of `camera_depth` by the increments (w, b) of the pose that `sampson` describes.

    With p the projector's ray in camera axes, n = d x p and N = t x p, depth is N . n / n . n. The derivatives of both
    products by p and by t are cross products; w turns p, b turns t.
    """
    p = d_projector @ R.T
    n, N = cross(d_camera, p), cross(np.broadcast_to(t, p.shape), p)
    over = 1 / (n * n).sum(-1, keepdims=True).clip(1e-300)
    depth = (N * n).sum(-1, keepdims=True) * over
    by_p = over * (cross(n, np.broadcast_to(t, p.shape)) + cross(N - 2 * depth * n, d_camera))
    by_t = over * cross(p, n)
    by_b = by_t @ np.cross(direction_basis(t), t, axisa=0, axisb=0).T
    return np.concatenate([cross(p, by_p), by_b], 1)
