"""Signed distances of simple solids, how they are joined, and meshes of them. Lengths in mm, z is up."""

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
import trimesh
from numpy import ndarray
from skimage.measure import marching_cubes

Solid = Callable[[ndarray], ndarray]
"""Signed distance of points (..., 3), negative inside; may be a bound instead of the distance itself."""


def ball(centre: Sequence[float], radii: float | Sequence[float]) -> Solid:
    """A ball, or an ellipsoid with three radii."""
    r = np.broadcast_to(np.asarray(radii, dtype=float), 3)
    return lambda p: (np.linalg.norm((p - np.asarray(centre)) / r, axis=-1) - 1) * r.min()


def block(centre: Sequence[float], sides: Sequence[float], rounding: float = 0.5, turn_deg: float = 0.0) -> Solid:
    """A box with rounded edges, turned about the vertical through its centre."""
    half = np.asarray(sides, dtype=float) / 2 - rounding
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))

    def distance(p: ndarray) -> ndarray:
        x, y, z = np.moveaxis(p - np.asarray(centre), -1, 0)
        q = np.abs(np.stack([c * x + s * y, c * y - s * x, z], -1)) - half
        return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0) - rounding

    return distance


def rod(start: Sequence[float], end: Sequence[float], radius: float, end_radius: float | None = None) -> Solid:
    """A capsule between two points, or a cone with round ends."""
    a, d = np.asarray(start, dtype=float), np.subtract(end, start).astype(float)
    last = radius if end_radius is None else end_radius

    def distance(p: ndarray) -> ndarray:
        t = np.clip((p - a) @ d / (d @ d), 0, 1)
        return np.linalg.norm(p - a - t[..., None] * d, axis=-1) - (radius + t * (last - radius))

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


def turned(profile: Sequence[tuple[float, float]]) -> Solid:
    """A solid of revolution about z: (height, radius) from bottom to top, straight between."""
    z, r = np.asarray(profile, dtype=float).T
    steepest = float(np.hypot(1, np.max(np.abs(np.diff(r) / np.diff(z)))))

    def distance(p: ndarray) -> ndarray:
        side = (np.hypot(p[..., 0], p[..., 1]) - np.interp(p[..., 2], z, r)) / steepest
        return np.maximum(side, np.maximum(z[0] - p[..., 2], p[..., 2] - z[-1]))

    return distance


def ring(centre: Sequence[float], radius: float, thickness: float, axis: int = 2) -> Solid:
    """A torus; `thickness` is the radius of its tube."""

    def distance(p: ndarray) -> ndarray:
        q = p - np.asarray(centre)
        return np.hypot(np.linalg.norm(np.delete(q, axis, -1), axis=-1) - radius, q[..., axis]) - thickness

    return distance


def moved(solid: Solid, shift: Sequence[float], turn_deg: float = 0.0, tilt_deg: float = 0.0) -> Solid:
    """Tilted about y, turned about z, then shifted."""
    a, b = np.radians(turn_deg), np.radians(tilt_deg)
    turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    tilt = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    return lambda p: solid((p - np.asarray(shift)) @ (turn @ tilt))


def joined(*solids: Solid, blend: float = 0.0) -> Solid:
    """The union; with `blend`, of its size in mm, the seams are rounded."""

    def distance(p: ndarray) -> ndarray:
        result = solids[0](p)
        for solid in solids[1:]:
            other = solid(p)
            h = np.maximum(blend - np.abs(result - other), 0) / max(blend, 1e-9)
            result = np.minimum(result, other) - h * h * blend / 4
        return result

    return distance


def without(solid: Solid, *holes: Solid) -> Solid:
    """What is left of a solid."""

    def distance(p: ndarray) -> ndarray:
        result = solid(p)
        for hole in holes:
            result = np.maximum(result, -hole(p))
        return result

    return distance


def meshed(solid: Solid, half: Sequence[float], voxel: float = 0.8) -> trimesh.Trimesh:
    """Marching cubes in a box from -half to half. Raises ValueError if the solid leaves the box."""
    axes = [np.arange(-h, h + voxel, voxel) for h in half]
    slabs = [solid(np.stack(np.meshgrid(x, *axes[1:], indexing="ij"), -1))[0] for x in axes[0][:, None]]
    values = np.stack(slabs).astype(np.float32)
    rims = (values[[0, -1]], values[:, [0, -1]], values[:, :, [0, -1]])
    if any(rim.min() <= 0 for rim in rims):
        raise ValueError("the solid does not fit into its box")
    points, faces, _, _ = marching_cubes(values, 0.0, spacing=(voxel,) * 3, gradient_direction="descent")
    return trimesh.Trimesh(points + [a[0] for a in axes], faces, process=False)


def tube(path: ndarray, radius: float, closed: bool = False, around: int = 20) -> trimesh.Trimesh:
    """A pipe along a path (n, 3), with half-open ends unless it is closed."""
    path = np.asarray(path, dtype=float)
    along = np.roll(path, -1, 0) - np.roll(path, 1, 0) if closed else np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    first = np.cross(along[0], [0.3, 0.5, 0.81])
    sides = [first / np.linalg.norm(first)]
    for direction in along[1:]:
        side = sides[-1] - direction * (sides[-1] @ direction)
        sides.append(side / np.linalg.norm(side))
    u = np.stack(sides)
    v = np.cross(along, u)
    angle = np.arange(around) * 2 * np.pi / around
    rings = path[:, None] + radius * (u[:, None] * np.cos(angle)[:, None] + v[:, None] * np.sin(angle)[:, None])
    n = len(path)
    i, k = np.meshgrid(np.arange(n if closed else n - 1), np.arange(around), indexing="ij")
    a, b = i * around + k, i * around + (k + 1) % around
    c, d = (i + 1) % n * around + k, (i + 1) % n * around + (k + 1) % around
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)])
    return trimesh.Trimesh(rings.reshape(-1, 3), faces, process=False)


def sheet(
    height: Callable[[ndarray, ndarray], ndarray], sides: tuple[float, float], thickness: float
) -> trimesh.Trimesh:
    """A plate whose upper side is `height(x, y)`, and whose lower side is `thickness` below it."""
    x, y = (np.linspace(-s / 2, s / 2, int(s / 0.7)) for s in sides)
    X, Y = np.meshgrid(x, y, indexing="ij")
    top = np.stack([X, Y, height(X, Y)], -1).reshape(-1, 3)
    n, m = X.shape
    index = np.arange(n * m).reshape(n, m)
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    upper = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    rim = np.concatenate([index[:, 0], index[-1, 1:], index[-2::-1, -1], index[0, -2::-1]])
    wall = [face for p, q in pairwise(rim) for face in ((p, p + n * m, q), (q, p + n * m, q + n * m))]
    faces = np.concatenate([upper, upper[:, ::-1] + n * m, np.array(wall)])
    return trimesh.Trimesh(np.concatenate([top, top - [0, 0, thickness]]), faces, process=False)
