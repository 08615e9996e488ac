"""Lines as thin rods: one mesh for any number of them, where the viewer has no line segments."""

import numpy as np
from jaxtyping import Float, Int64
from numpy import ndarray

_SIDES = 3


def rods(segments: Float[ndarray, "n 2 3"], radius: float) -> tuple[Float[ndarray, "v 3"], Int64[ndarray, "f 3"]]:
    """Vertices and triangles of open prisms around the segments; those without a length are left out."""
    axis = segments[:, 1] - segments[:, 0]
    length = np.linalg.norm(axis, axis=1)
    kept = np.isfinite(length) & (length > 0)
    segments, axis = segments[kept], axis[kept] / length[kept, None]
    least = np.eye(3)[np.argmin(np.abs(axis), axis=1)]
    u = np.cross(axis, least)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(axis, u)
    angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
    ring = radius * (np.cos(angle)[None, :, None] * u[:, None] + np.sin(angle)[None, :, None] * v[:, None])
    vertices = (segments[:, :, None] + ring[:, None]).reshape(-1, 3)
    k, after = np.arange(_SIDES), (np.arange(_SIDES) + 1) % _SIDES
    one = np.concatenate([np.stack([k, after, after + _SIDES], 1), np.stack([k, after + _SIDES, k + _SIDES], 1)])
    faces = one[None] + 2 * _SIDES * np.arange(len(segments))[:, None, None]
    return vertices, faces.reshape(-1, 3).astype(np.int64)
