"""Triangles in float64: nearest points, neighbours, and which of them are long and thin."""

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

_THIN = 0.1  # height divided by length


def nearest_on_triangle(
    p: Float[ndarray, "n 3"], a: Float[ndarray, "n 3"], b: Float[ndarray, "n 3"], c: Float[ndarray, "n 3"]
) -> Float[ndarray, "n 3"]:
    """Nearest point to each `p` on its triangle `a b c`: the foot on the plane if inside, else on the nearest edge."""
    normal = np.cross(b - a, c - a)
    norm2 = (normal**2).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        foot = p - (((p - a) * normal).sum(1) / norm2)[:, None] * normal
        inside = norm2 > 0
        for start, end in ((a, b), (b, c), (c, a)):
            inside &= (np.cross(end - start, foot - start) * normal).sum(1) >= 0
    best = np.where(inside[:, None], foot, np.inf)
    distance2 = np.where(inside, 0.0, np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        side = end - start
        t = ((p - start) * side).sum(1) / np.maximum((side**2).sum(1), 1e-300)
        point = start + np.clip(t, 0, 1)[:, None] * side
        square = ((p - point) ** 2).sum(1)
        nearer = square < distance2
        best, distance2 = np.where(nearer[:, None], point, best), np.where(nearer, square, distance2)
    return best


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
