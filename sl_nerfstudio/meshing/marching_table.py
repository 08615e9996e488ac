"""The 256 cases of marching cubes, derived by program, so that the surface is closed by construction.

Corner `c` of a cell lies at `(c & 1, c >> 1 & 1, c >> 2 & 1)`. Bit `c` of a case is set where the field is
negative there (inside). Edge `4 * axis + k` runs along `axis`; see EDGE_CORNERS.

On every face of the cell the negative corners are separated: a diagonal pair gives two segments, each cutting off one
negative corner. This depends only on the signs at that face, so the two cells at a face draw the same segments, and
each edge that the surface cuts has exactly one segment on each of its faces: the segments form closed loops
(Lorensen and Cline, SIGGRAPH 1987, with the face rule that makes their table free of holes).
"""

from functools import cache
from itertools import combinations

import numpy as np
from jaxtyping import Int
from numpy import ndarray

AXIS_STEP = (1, 2, 4)  # what a step along x, y, z adds to a corner's number


def _edge_corners() -> list[tuple[int, int]]:
    return [(c, c + step) for step in AXIS_STEP for c in range(8) if not c & step]


EDGE_CORNERS: tuple[tuple[int, int], ...] = tuple(_edge_corners())
"""Lower and upper corner of each of the 12 edges; edges 0 to 3 along x, 4 to 7 along y, 8 to 11 along z."""

_EDGE_OF_CORNERS = {frozenset(pair): edge for edge, pair in enumerate(EDGE_CORNERS)}


def _face_corners() -> list[tuple[int, int, int, int]]:
    """Corners of the six faces, counter-clockwise as seen from outside the cell."""
    faces = []
    for axis in range(3):
        u, v, w = AXIS_STEP[(axis + 1) % 3], AXIS_STEP[(axis + 2) % 3], AXIS_STEP[axis]
        faces.append((0, v, u + v, u))
        faces.append((w, w + u, w + u + v, w + v))
    return faces


FACE_CORNERS = _face_corners()
_FACE_EDGES = [{_EDGE_OF_CORNERS[frozenset((f[i], f[i - 1]))] for i in range(4)} for f in FACE_CORNERS]


def _loops(case: int) -> list[list[int]]:
    """Closed polygons of cut edges, counter-clockwise as seen from the positive side."""
    successor: dict[int, int] = {}
    for face in FACE_CORNERS:
        inside = [bool(case >> c & 1) for c in face]
        for i in range(4):
            if inside[i] and not inside[i - 1]:  # a sequence of negative corners begins here
                j = i
                while inside[(j + 1) % 4]:
                    j += 1
                enters = _EDGE_OF_CORNERS[frozenset((face[i - 1], face[i]))]
                leaves = _EDGE_OF_CORNERS[frozenset((face[j % 4], face[(j + 1) % 4]))]
                successor[enters] = leaves
    loops = []
    while successor:
        loop = [next(iter(successor))]
        while (following := successor.pop(loop[-1])) != loop[0]:
            loop.append(following)
        loops.append(loop)
    return loops


def _on_one_face(a: int, b: int) -> bool:
    return any(a in edges and b in edges for edges in _FACE_EDGES)


def _triangulate(loop: list[int]) -> list[tuple[int, int, int]] | None:
    """Triangles of a loop without a diagonal inside a face of the cell; None if there is no such choice.

    The neighbouring cell could draw the same diagonal inside a face: four triangles would meet in it.
    """
    if len(loop) == 3:
        return [(loop[0], loop[1], loop[2])]
    n = len(loop)
    for i, j in combinations(range(n), 2):
        if j - i in (1, n - 1) or _on_one_face(loop[i], loop[j]):
            continue
        left, right = _triangulate(loop[i : j + 1]), _triangulate(loop[j:] + loop[: i + 1])
        if left is not None and right is not None:
            return left + right
    return None


@cache
def triangle_table() -> tuple[Int[ndarray, "256 t 3"], Int[ndarray, "256"]]:
    """Edges of the triangles of each case (-1 beyond the last) and how many triangles it has.

    Triangles are counter-clockwise as seen from the positive side, so normals point outward.
    Raises ValueError if a case has no such triangulation (tests show that all have one).
    """
    cases = []
    for case in range(256):
        triangles: list[tuple[int, int, int]] = []
        for loop in _loops(case):
            clean = _triangulate(loop)
            if clean is None:
                raise ValueError(f"case {case} has no triangulation without diagonals in faces")
            triangles += clean
        cases.append(triangles)
    table = np.full((256, max(map(len, cases)), 3), -1, dtype=np.int64)
    for case, triangles in enumerate(cases):
        if triangles:
            table[case, : len(triangles)] = triangles
    return table, np.array([len(triangles) for triangles in cases], dtype=np.int64)
