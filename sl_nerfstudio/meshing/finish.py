"""Finishing a mesh: its observed part marked, holes filled, a closed solid, fewer triangles."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from operator import methodcaller
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from numpy import ndarray
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import pdist
from torch import Tensor

from sl_nerfstudio.meshing.extract import Field
from sl_nerfstudio.meshing.mesh import Mesh, ray_scene
from sl_nerfstudio.meshing.visibility import Trimmed

# A mesh whose vertices say whether they were observed.


@dataclass(frozen=True)
class MarkedMesh:
    """A surface, part of which may be the field's own continuation."""

    mesh: Mesh
    invented: Bool[ndarray, "v"]  # no frame observed the vertex

    def with_faces(self, keep: Bool[ndarray, "f"]) -> "MarkedMesh":
        """The chosen triangles, with the vertices that they use."""
        return MarkedMesh(self.mesh.with_faces(keep), self.invented[self.mesh.corners_of(keep)])

    def invented_share(self) -> float:
        """Share of the area whose triangles have a corner that no frame observed."""
        areas = self.mesh.face_areas()
        return float(areas[self.invented[self.mesh.faces].any(1)].sum() / max(areas.sum(), 1e-300))

    def largest_component(self) -> "MarkedMesh":
        """The connected piece with the largest area."""
        piece = self.mesh.component_of_faces()
        return self.with_faces(piece == int(np.argmax(np.bincount(piece, self.mesh.face_areas()))))


# The points of a surface that are closest to given ones.


@dataclass(frozen=True)
class ClosestPoints:
    """Points of a mesh, each the closest to a given one; lengths in the mesh's unit."""

    distance: Float64[ndarray, "n"]
    triangle: Int64[ndarray, "n"]
    weights: Float64[ndarray, "n 3"]  # of the triangle's corners, to single precision


class ClosestSurface:
    """A mesh, prepared to be asked for closest points."""

    def __init__(self, mesh: Mesh) -> None:
        """`mesh` may be open."""
        self._centre = mesh.vertices.mean(0)
        self._scale = max(float(np.ptp(mesh.vertices, axis=0).max()), 1e-300)
        self._scene = ray_scene((mesh.vertices - self._centre) / self._scale, mesh.faces)

    def closest(self, points: Float64[ndarray, "n 3"]) -> ClosestPoints:
        """Find the closest point of the mesh to every point."""
        from sl_nerfstudio.late_imports import open3d as o3d

        scaled = ((points - self._centre) / self._scale).astype(np.float32)
        found = self._scene.compute_closest_points(o3d.core.Tensor(scaled))
        u, v = found["primitive_uvs"].numpy().T.astype(np.float64)
        there = found["points"].numpy() * self._scale + self._centre
        distance = np.linalg.norm(points - there, axis=1).astype(np.float64)
        return ClosestPoints(distance, found["primitive_ids"].numpy().astype(np.int64), np.stack([1 - u - v, u, v], 1))


# A field whose zero level is closed: it ends at the walls of its box, and at planes.

_MARGIN = 2e-3  # of the box's half side: what is nearer to its walls is outside
_FACETS = 64  # of a convex hull, the largest ones: the many small ones are where the surface was observed

Planes = list[tuple[Float64[ndarray, "3"], float]]
"""Unit normals n and offsets d: points with n . p > d are above."""


def closed_field(field: Field, planes: Planes, device: torch.device) -> Field:
    """The solid of a field within the box [-1, 1]^3 and above planes, which are in the box's frame.

    A point is inside if it is inside the field's surface, inside the box, and above every plane: the largest of these
    signed distances, so walls and planes cut the solid with flat faces.
    """
    normals = [(torch.as_tensor(n, dtype=torch.float32, device=device), d) for n, d in planes]

    def solid(p: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        found = torch.maximum(field(p), p.abs().amax(-1) - (1 - _MARGIN))
        for normal, offset in normals:
            found = torch.maximum(found, offset - p @ normal)
        return found

    return solid


def hull_planes(points: Float[ndarray, "n 3"], margin: float) -> Planes:
    """The largest faces of the convex hull of points, moved out by `margin`, with the points above them.

    Without any if the points have no volume.
    """
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return []
    a, b, c = (points[hull.simplices[:, k]] for k in range(3))
    facet, of_facet = np.unique(hull.equations.round(6), axis=0, return_inverse=True)
    area = np.bincount(of_facet.reshape(-1), np.linalg.norm(np.cross(b - a, c - a), axis=1), len(facet))
    return [(-row[:3], float(row[3]) - margin) for row in facet[np.argsort(-area)[:_FACETS]]]


# Fewer triangles by quadric edge collapse (Garland and Heckbert, SIGGRAPH 1997), and what that changed.

_BORDERS = 100.0  # weight of errors across borders beside those across the surface: 1 lets jagged borders recede


@dataclass(frozen=True)
class Decimated:
    """A mesh of fewer triangles; lengths in its unit."""

    mesh: Mesh
    nearest: Int64[ndarray, "v"]  # for each of its vertices, the nearest one of the triangle below it in the old mesh
    distance: Float64[ndarray, "v"]  # of its vertices from the old surface
    triangles_before: int
    rms_error: float  # distance of the old vertices from the new surface
    largest_error: float  # the largest distance of vertices of either mesh from the other's surface


def decimate(mesh: Mesh, triangles: int) -> Decimated:
    """Collapse edges with open3d until at most `triangles` are left. Vertices of the result lie near the old surface.

    A mesh that has no more stays as it is.
    """
    fewer = mesh
    if len(mesh.faces) > triangles:
        collapse = methodcaller("simplify_quadric_decimation", triangles, boundary_weight=_BORDERS)
        fewer = simplified(mesh, collapse)
        fewer = fewer.with_faces(np.ones(len(fewer.faces), dtype=bool))
    found = ClosestSurface(mesh).closest(fewer.vertices)
    back = ClosestSurface(fewer).closest(mesh.vertices).distance
    nearest = mesh.faces[found.triangle, found.weights.argmax(1)]
    rms, largest = float(np.sqrt((back**2).mean())), float(max(back.max(), found.distance.max()))
    return Decimated(fewer, nearest, found.distance, len(mesh.faces), rms, largest)


def simplified(mesh: Mesh, simplify: Callable[[Any], Any]) -> Mesh:
    """What `simplify` makes of the mesh as a TriangleMesh of open3d, in units of its size and about its middle."""
    from sl_nerfstudio.late_imports import open3d as o3d

    centre, scale = mesh.vertices.mean(0), max(float(np.ptp(mesh.vertices, axis=0).max()), 1e-300)
    vertices = o3d.utility.Vector3dVector((mesh.vertices - centre) / scale)
    after = simplify(o3d.geometry.TriangleMesh(vertices, o3d.utility.Vector3iVector(mesh.faces.astype(np.int32))))
    return Mesh(np.asarray(after.vertices) * scale + centre, np.asarray(after.triangles).astype(np.int64))


_DENIED = 0.5
"""Share of a piece's vertices that several frames contradict from which on the hole is real: they look through it."""
_MANY = 50  # points, of which the convex hull is found before they are compared in pairs


@dataclass(frozen=True)
class FilledHoles:
    """Holes that were closed, and those that were not."""

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
    piece = Mesh(mesh.vertices, faces).component_of_faces()
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
            with suppress(QhullError):  # all of them lie in a plane: they are compared as they are
                points = points[ConvexHull(points).vertices] if len(points) > _MANY else points
            size[k] = pdist(points).max(initial=0.0)
    return size
