"""Triangles in float64: nearest points, neighbours, and which of them are long and thin."""

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from sl_nerfstudio.compiled import compiled

_THIN = 0.1  # height divided by length


def nearest_on_triangle(
    p: Float[ndarray, "n 3"], a: Float[ndarray, "n 3"], b: Float[ndarray, "n 3"], c: Float[ndarray, "n 3"]
) -> Float[ndarray, "n 3"]:
    """Nearest point to each `p` on its triangle `a b c`: the foot on the plane if inside, else on the nearest edge."""
    out = np.empty(p.shape)
    _nearest(p, a, b, c, out)
    return out


@compiled
def _cross(ax, ay, az, bx, by, bz):
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@compiled
def _nearest(points, firsts, seconds, thirds, out):
    for i in range(len(points)):
        p, a, b, c = points[i], firsts[i], seconds[i], thirds[i]
        nx, ny, nz = _cross(b[0] - a[0], b[1] - a[1], b[2] - a[2], c[0] - a[0], c[1] - a[1], c[2] - a[2])
        norm2 = nx * nx + ny * ny + nz * nz
        inside = norm2 > 0
        x, y, z = p
        if inside:
            away = ((p[0] - a[0]) * nx + (p[1] - a[1]) * ny + (p[2] - a[2]) * nz) / norm2
            x, y, z = p[0] - away * nx, p[1] - away * ny, p[2] - away * nz
            for start, end in ((a, b), (b, c), (c, a)):
                sx, sy, sz = _cross(
                    *(end[0] - start[0], end[1] - start[1], end[2] - start[2]),
                    *(x - start[0], y - start[1], z - start[2]),
                )
                inside = inside and sx * nx + sy * ny + sz * nz >= 0
        if inside:
            out[i, 0], out[i, 1], out[i, 2] = x, y, z
            continue
        best = np.inf
        for start, end in ((a, b), (b, c), (c, a)):
            sx, sy, sz = end[0] - start[0], end[1] - start[1], end[2] - start[2]
            along = (p[0] - start[0]) * sx + (p[1] - start[1]) * sy + (p[2] - start[2]) * sz
            t = min(max(along / max(sx * sx + sy * sy + sz * sz, 1e-300), 0.0), 1.0)
            x, y, z = start[0] + t * sx, start[1] + t * sy, start[2] + t * sz
            square = (p[0] - x) ** 2 + (p[1] - y) ** 2 + (p[2] - z) ** 2
            if square < best:
                best = square
                out[i, 0], out[i, 1], out[i, 2] = x, y, z


def neighbours(faces: Int[ndarray, "f 3"]) -> Int[ndarray, "f 3"]:
    """The triangle on the other side of each edge (a b, b c, c a); the triangle itself where there is none."""
    count = len(faces)
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], -1).reshape(-1, 2), axis=1)
    order = np.lexsort(edges.T)
    same = (edges[order[:-1]] == edges[order[1:]]).all(1)
    left, right = order[:-1][same], order[1:][same]
    out = np.repeat(np.arange(count), 3)
    out[left], out[right] = right // 3, left // 3
    return out.reshape(count, 3)


def thin(corners: Float[ndarray, "f 3 3"]) -> Bool[ndarray, "f"]:
    """Which triangles are at least ten times longer than high."""
    longest2 = ((np.roll(corners, -1, axis=1) - corners) ** 2).sum(2).max(1)
    doubled = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return doubled < _THIN * longest2
