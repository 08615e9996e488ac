"""Solids from formulas, and how they are meshed. Lengths in mm, z is up."""

from collections.abc import Callable, Sequence

import numpy as np
import trimesh
from numpy import ndarray
from skimage.measure import marching_cubes

Solid = Callable[[ndarray], ndarray]
"""Signed distance of points (n, 3), negative inside; may be a bound instead of the distance itself."""


def ball(centre: Sequence[float], radii: float | Sequence[float]) -> Solid:
    """A ball, or an ellipsoid with three radii."""
    r = np.broadcast_to(np.asarray(radii, dtype=float), 3)
    return lambda p: (np.linalg.norm((p - np.asarray(centre)) / r, axis=-1) - 1) * r.min()


def block(centre: Sequence[float], sides: Sequence[float], rounding: float = 0.5) -> Solid:
    """A box with rounded edges."""
    half = np.asarray(sides, dtype=float) / 2 - rounding

    def distance(p: ndarray) -> ndarray:
        q = np.abs(p - np.asarray(centre)) - half
        return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0) - rounding

    return distance


def drum(centre: Sequence[float], radius: float, height: float, axis: int = 2) -> Solid:
    """A cylinder along one of the axes."""

    def distance(p: ndarray) -> ndarray:
        q = p - np.asarray(centre)
        across = np.linalg.norm(np.delete(q, axis, -1), axis=-1) - radius
        along = np.abs(q[..., axis]) - height / 2
        return np.minimum(np.maximum(across, along), 0) + np.hypot(np.maximum(across, 0), np.maximum(along, 0))

    return distance


def prism(corners: int, radius: float, height: float) -> Solid:
    """A regular prism about z; `radius` is that of its inner circle."""

    def distance(p: ndarray) -> ndarray:
        step = 2 * np.pi / corners
        angle = np.mod(np.arctan2(p[..., 1], p[..., 0]) + step / 2, step) - step / 2
        return np.maximum(np.hypot(p[..., 0], p[..., 1]) * np.cos(angle) - radius, np.abs(p[..., 2]) - height / 2)

    return distance


def moved(solid: Solid, shift: Sequence[float], turn_deg: float = 0.0, tilt_deg: float = 0.0) -> Solid:
    """Tilted about y, turned about z, then shifted."""
    a, b = np.radians(turn_deg), np.radians(tilt_deg)
    turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    tilt = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    return lambda p: solid((p - np.asarray(shift)) @ (turn @ tilt))


def meshed(solid: Solid, half: Sequence[float], voxel: float = 0.8) -> trimesh.Trimesh:
    """Marching cubes in a box from -half to half. Raises ValueError if the solid leaves the box."""
    axes = [np.arange(-h, h + voxel, voxel) for h in half]
    shape = len(axes[1]), len(axes[2])
    slabs = [np.stack(np.meshgrid(x, *axes[1:], indexing="ij"), -1).reshape(-1, 3) for x in axes[0][:, None]]
    values = np.stack([solid(slab).reshape(shape) for slab in slabs]).astype(np.float32)
    rims = (values[[0, -1]], values[:, [0, -1]], values[:, :, [0, -1]])
    if any(rim.min() <= 0 for rim in rims):
        raise ValueError("the solid does not fit into its box")
    points, faces, _, _ = marching_cubes(values, 0.0, spacing=(voxel,) * 3, gradient_direction="descent")
    return trimesh.Trimesh(points + [a[0] for a in axes], faces, process=False)
