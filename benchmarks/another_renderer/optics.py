"""Lenses, poses and rays, by the formulas of docs/scan-format.md. A device looks along its -z, and +y is up."""

from dataclasses import dataclass

import numpy as np
from numpy import ndarray
from scipy.spatial.transform import Rotation


def dots(a: ndarray, b: ndarray) -> ndarray:
    """Products of vectors (..., k), summed over the last axis; much faster than by `sum`."""
    return np.einsum("...i,...i->...", a, b)


@dataclass(frozen=True)
class Lens:
    """Intrinsics in pixels; the centre of the first pixel is (0.5, 0.5), y points down."""

    w: int
    h: int
    f: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0

    def document(self) -> dict[str, float]:
        """As in the plain JSON of sl-process."""
        return {"w": self.w, "h": self.h, "fl_x": self.f, "fl_y": self.f, "cx": self.cx, "cy": self.cy,
                "k1": self.k1, "k2": self.k2, "p1": 0.0, "p2": 0.0}  # fmt: skip

    def pixels(self, p: ndarray) -> ndarray:
        """Pixels (..., 2) of points (..., 3) in device axes; NaN behind the device."""
        with np.errstate(divide="ignore", invalid="ignore"):
            n = np.stack([p[..., 0], -p[..., 1]], -1) / -p[..., 2:]
        n[p[..., 2] >= 0] = np.nan
        r2 = dots(n, n)[..., None]
        return self.f * n * (1 + self.k1 * r2 + self.k2 * r2**2) + [self.cx, self.cy]

    def directions(self, uv: ndarray) -> ndarray:
        """Unit directions (..., 3) in device axes of pixels (..., 2)."""
        distorted = (uv - [self.cx, self.cy]) / self.f
        n = distorted.copy()
        for _ in range(8):
            r2 = dots(n, n)[..., None]
            n = distorted / (1 + self.k1 * r2 + self.k2 * r2**2)
        d = np.concatenate([n[..., :1], -n[..., 1:], -np.ones_like(n[..., :1])], -1)
        return d / np.sqrt(dots(d, d))[..., None]

    def turned_to_middle(self) -> ndarray:
        """Rotation (4, 4) in device axes, after which the middle of the image looks where its axis did."""
        right, down = (self.w / 2 - self.cx) / self.f, (self.h / 2 - self.cy) / self.f
        if max(abs(right), abs(down)) < 0.1:  # as exact as people aim
            return np.eye(4)
        middle, axis = np.array([right, -down, -1.0]), np.array([0.0, 0.0, -1.0])
        T = np.eye(4)
        T[:3, :3] = Rotation.align_vectors(axis[None], middle[None])[0].as_matrix()
        return T


def looking(eye: ndarray, at: ndarray, roll: float) -> ndarray:
    """Pose (4, 4), device to world, of a device at `eye` that looks at a point; `roll` in radian about its sight."""
    back = (eye - at) / np.linalg.norm(eye - at)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    up = np.cross(back, right)
    c, s = np.cos(roll), np.sin(roll)
    T = np.eye(4)
    T[:3, :3] = np.stack([c * right + s * up, c * up - s * right, back], 1)
    T[:3, 3] = eye
    return T


def into_device(T_world_device: ndarray, p_world: ndarray) -> ndarray:
    """Points (..., 3) in the axes of the device."""
    return (p_world - T_world_device[:3, 3]) @ T_world_device[:3, :3]


def nearest_points(o1: ndarray, d1: ndarray, o2: ndarray, d2: ndarray) -> ndarray:
    """Middles (n, 3) of the shortest connections of rays from o1 along d1 (n, 3) and from o2 along d2."""
    a, b, c = dots(d1, d1), dots(d1, d2), dots(d2, d2)
    e, f = d1 @ (o1 - o2), d2 @ (o1 - o2)
    with np.errstate(divide="ignore", invalid="ignore"):
        s, t = (b * f - c * e) / (a * c - b * b), (a * f - b * e) / (a * c - b * b)
    return (o1 + s[:, None] * d1 + o2 + t[:, None] * d2) / 2


def triangulated(
    camera: Lens, T_camera: ndarray, uv: ndarray, projector: Lens, T_projector: ndarray, xy: ndarray
) -> ndarray:
    """Points (n, 3) in the world that camera pixels and projector pixels see."""
    d1, d2 = camera.directions(uv) @ T_camera[:3, :3].T, projector.directions(xy) @ T_projector[:3, :3].T
    return nearest_points(T_camera[:3, 3], d1, T_projector[:3, 3], d2)
