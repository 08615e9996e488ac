"""Holes of a trimmed mesh, closed by what was trimmed away: the zero level of the field."""

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int64
from numpy import ndarray
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import pdist

from sl_nerfstudio.geometry.connectivity import component_labels
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.trim import Trimmed

_DENIED = 0.5
"""Share of a piece's vertices that several frames contradict from which on the hole is real: they look through it."""
_MANY = 50  # points, of which the convex hull is found before they are compared in pairs


@dataclass(frozen=True)
class FilledHoles:
    """Which holes were closed, and which were not."""

    kept: Bool[ndarray, "f"]  # triangles of the whole mesh: those of the trimmed mesh, and those that close holes
    closed: int  # holes
    area: float  # of what closes them, in the square of the mesh's unit
    too_large: int  # holes that stay open because they are larger than the limit
    denied: int  # that stay open because frames look through them


def fill_holes(mesh: Mesh, trimmed: Trimmed, largest: float) -> FilledHoles:
    """Close the holes of `trimmed` with the pieces of `mesh` that trimming removed there.

    A hole is a connected piece of the removed surface all of whose borders belong to the kept surface. Its size is the
    largest distance between two of its points, so that a deep bulge behind a narrow opening counts as what it is.
    Holes up to the length `largest` are closed, except where frames look through them.
    """
    removed = np.flatnonzero(~trimmed.kept)
    faces = mesh.faces[removed]
    piece = _pieces(faces, len(mesh.vertices))
    count = int(piece.max(initial=-1)) + 1
    holes = _bordered(mesh, faces, mesh.faces[trimmed.kept], piece, count)
    size = _sizes(mesh, faces, piece, holes, largest)
    members = np.bincount(piece, minlength=count)
    denied = np.bincount(piece, trimmed.denied[faces].mean(1), count) > _DENIED * members
    good = holes & (size <= largest) & ~denied
    kept = trimmed.kept.copy()
    kept[removed[good[piece]]] = True
    return FilledHoles(
        kept,
        closed=int(good.sum()),
        area=float(mesh.face_areas()[removed[good[piece]]].sum()),
        too_large=int((holes & (size > largest)).sum()),
        denied=int((holes & (size <= largest) & denied).sum()),
    )


def _keys(faces: Int64[ndarray, "f 3"], vertices: int, reverse: bool = False) -> Int64[ndarray, "e"]:
    """A number for each directed side of each triangle, side by side, or for the same sides run through backwards."""
    a, b = (np.roll(faces, -1, 1), faces) if reverse else (faces, np.roll(faces, -1, 1))
    return (a * vertices + b).ravel()


def _pieces(faces: Int64[ndarray, "f 3"], vertices: int) -> Int64[ndarray, "f"]:
    """Number of the piece, from 0, of each triangle; triangles that share a side are in one."""
    there, back = _keys(faces, vertices), _keys(faces, vertices, reverse=True)
    _, side = np.unique(np.minimum(there, back), return_inverse=True)
    triangle = np.repeat(np.arange(len(faces)), 3)
    nodes = len(faces) + int(side.max(initial=-1)) + 1
    label = component_labels(triangle, len(faces) + side.reshape(-1), nodes)[: len(faces)]
    return np.unique(label, return_inverse=True)[1].reshape(-1).astype(np.int64)


def _bordered(
    mesh: Mesh, faces: Int64[ndarray, "f 3"], kept: Int64[ndarray, "k 3"], piece: Int64[ndarray, "f"], count: int
) -> Bool[ndarray, "pieces"]:
    """Pieces that have a border, all of which is a border of the kept surface."""
    n, of_side = len(mesh.vertices), np.repeat(piece, 3)
    back = _keys(faces, n, reverse=True)
    inner, at_kept = np.isin(back, _keys(faces, n)), np.isin(back, _keys(kept, n))
    open_end = np.bincount(of_side, ~inner & ~at_kept, count) > 0
    return (np.bincount(of_side, at_kept, count) > 0) & ~open_end


def _sizes(
    mesh: Mesh,
    faces: Int64[ndarray, "f 3"],
    piece: Int64[ndarray, "f"],
    chosen: Bool[ndarray, "pieces"],
    largest: float,
) -> Float[ndarray, "pieces"]:
    """Largest distance between two points of each chosen piece; inf for the others and where a side alone is larger."""
    size = np.full(len(chosen), np.inf)
    order = np.argsort(piece, kind="stable")
    first = np.searchsorted(piece[order], np.arange(len(chosen) + 1))
    for k in np.flatnonzero(chosen).tolist():
        points = mesh.vertices[np.unique(faces[order[first[k] : first[k + 1]]])]
        if np.ptp(points, axis=0).max() <= largest:
            size[k] = _diameter(points)
    return size


def _diameter(points: Float[ndarray, "n 3"]) -> float:
    """The largest distance between two points; both are on the convex hull."""
    with suppress(QhullError):  # all of them lie in a plane: they are compared as they are
        points = points[ConvexHull(points).vertices] if len(points) > _MANY else points
    return float(pdist(points).max(initial=0.0))
