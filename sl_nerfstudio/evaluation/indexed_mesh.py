"""A triangle mesh with a search tree: nearest points, ray hits, occlusion, evenly spread samples."""

from dataclasses import dataclass, fields
from functools import cached_property, partial

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from sl_nerfstudio.evaluation.triangles import nearest_on_triangle, neighbours, thin
from sl_nerfstudio.geometry.open3d_core import open3d as o3d
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.threads import results, split, threads


@dataclass(frozen=True)
class Closest:
    """Nearest points on a surface."""

    distance: Float[ndarray, "n"]  # >= 0, in the surface's unit
    point: Float[ndarray, "n 3"]
    normal: Float[ndarray, "n 3"]  # unit normal of the triangle the point lies on, by its winding


@dataclass(frozen=True)
class RayHits:
    """First intersections of rays with a surface."""

    hit: Bool[ndarray, "n"]
    distance: Float[ndarray, "n"]  # along the unit direction; NaN where nothing is hit
    face: Int[ndarray, "n"]  # -1 where nothing is hit


class IndexedMesh:
    """A mesh with at least one triangle, in any unit and anywhere in space.

    Open3D computes in float32, so the mesh is centred and scaled to unit size inside: a scan far from
    its origin or in metres is measured as precisely as one near it or in millimetres.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self.vertices, self.faces = mesh.vertices, mesh.faces
        self.lower, self.upper = mesh.bounds()
        self.centre = (self.lower + self.upper) / 2
        self.diagonal = float(np.linalg.norm(self.upper - self.lower))
        self._scale = 1 / max(self.diagonal, 1e-300)
        self._scene = self._build(self.vertices, self.faces)

    def _inside(self, p: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
        return ((p - self.centre) * self._scale).astype(np.float32)

    def _build(self, vertices: Float[ndarray, "v 3"], faces: Int[ndarray, "f 3"]) -> o3d.t.geometry.RaycastingScene:
        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(o3d.core.Tensor(self._inside(vertices)), o3d.core.Tensor(faces.astype(np.uint32)))
        scene.cast_rays(o3d.core.Tensor(np.zeros((1, 6), np.float32)))  # builds the index, before threads share it
        return scene

    def _corners(self, face: Int[ndarray, "n"]) -> tuple[Float[ndarray, "n 3"], ...]:
        return tuple(self.vertices[self.faces[face, k]] for k in range(3))

    @cached_property
    def _neighbours(self) -> Int[ndarray, "f 3"]:
        return neighbours(self.faces)

    @cached_property
    def _by_thin(self) -> Bool[ndarray, "f"]:
        """Triangles that are long and thin, or have such a neighbour."""
        is_thin = thin(self.vertices[self.faces])
        return is_thin | is_thin[self._neighbours].any(1) if is_thin.any() else is_thin

    @cached_property
    def face_cross(self) -> Float[ndarray, "f 3"]:
        """Twice the area times the unit normal of each triangle."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        return np.cross(b - a, c - a)

    @cached_property
    def vertex_normals(self) -> Float[ndarray, "v 3"]:
        """Unit normals of the vertices."""
        return self.mesh.vertex_normals()

    @cached_property
    def area(self) -> float:
        """Total area of the triangles."""
        return float(np.linalg.norm(self.face_cross, axis=1).sum() / 2)

    def sample(self, count: int, seed: int) -> tuple[Float[ndarray, "n 3"], Float[ndarray, "n 3"]]:
        """`count` points spread evenly over the area, and their unit normals; the same for the same seed.

        Stratified along the cumulative area: every part of the surface gets its share of points.
        """
        rng = np.random.default_rng(seed)
        doubled = np.linalg.norm(self.face_cross, axis=1)
        cumulated = np.cumsum(doubled)
        position = (np.arange(count) + rng.random(count)) / count * cumulated[-1]
        face = np.minimum(np.searchsorted(cumulated, position, side="right"), len(self.faces) - 1)
        root, s = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
        a, b, c = (self.vertices[self.faces[face, k]] for k in range(3))
        points = (1 - root) * a + root * (1 - s) * b + root * s * c
        return points, self.face_cross[face] / np.maximum(doubled[face, None], 1e-300)

    def closest(self, points: Float[ndarray, "n 3"]) -> Closest:
        """Nearest point of the surface (on its triangles, not its vertices) for each point."""
        parts = [points[first:last] for first, last in split(len(points), threads(), 1)]
        found = results([partial(self._closest, part) for part in parts])
        return Closest(*(np.concatenate([getattr(part, f.name) for part in found]) for f in fields(Closest)))

    def _closest(self, points: Float[ndarray, "n 3"]) -> Closest:
        answer = self._scene.compute_closest_points(o3d.core.Tensor(self._inside(points)))
        face = answer["primitive_ids"].numpy().astype(np.int64)
        # Open3D's nearest point is good to 1e-7 of the size, except on long thin triangles (of a CAD cylinder), where
        # float32 can miss the right one. Therefore: the nearest of that triangle and its neighbours, in float64.
        foot = nearest_on_triangle(points, *self._corners(face))
        best = np.linalg.norm(points - foot, axis=1)
        near_thin = np.flatnonzero(self._by_thin[face])
        for other in self._neighbours[face[near_thin]].T:
            candidate = nearest_on_triangle(points[near_thin], *self._corners(other))
            distance = np.linalg.norm(points[near_thin] - candidate, axis=1)
            better = distance < best[near_thin]
            index = near_thin[better]
            best[index], foot[index] = distance[better], candidate[better]
            face[index] = other[better]
        length = np.linalg.norm(self.face_cross[face], axis=1, keepdims=True)
        return Closest(best, foot, self.face_cross[face] / np.maximum(length, 1e-300))

    def distance(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        """Distance of each point from the surface."""
        return self.closest(points).distance

    def cast(self, origins: Float[ndarray, "n 3"], directions: Float[ndarray, "n 3"]) -> RayHits:
        """What rays with unit `directions` hit first."""
        answer = self._scene.cast_rays(self._rays(origins, directions))
        t = answer["t_hit"].numpy().astype(np.float64)
        hit = np.isfinite(t)
        face = np.where(hit, answer["primitive_ids"].numpy().astype(np.int64), -1)
        corner, cross = self.vertices[self.faces[face, 0]], self.face_cross[face]
        slope = (cross * directions).sum(1)
        with np.errstate(divide="ignore", invalid="ignore"):
            exact = ((corner - origins) * cross).sum(1) / slope
        coarse = np.where(hit, t / self._scale, np.nan)
        # The float64 intersection with the plane of the triangle, except for rays almost parallel to it.
        near = np.abs(exact - coarse) < 1e-4 * self.diagonal
        return RayHits(hit, np.where(hit & near, exact, coarse), face)

    def occluded(
        self, points: Float[ndarray, "n 3"], target: Float[ndarray, "3"], tolerance: float = 1e-3
    ) -> Bool[ndarray, "n"]:
        """Whether the surface is between each point and `target`.

        Points may lie on the surface: what is closer than `tolerance` times the size of the mesh does not hide.
        """
        offset = target - points
        length = np.linalg.norm(offset, axis=1)
        direction = offset / np.maximum(length, 1e-300)[:, None]
        start = points + tolerance * self.diagonal * direction
        # Directions as long as the distance to the target: all rays then end at parameter 1.
        remaining = np.maximum(length - tolerance * self.diagonal, 0) * self._scale
        rays = self._rays(start, remaining[:, None] * direction)
        return self._scene.test_occlusions(rays, tnear=0.0, tfar=1.0).numpy()

    def _rays(self, origins: Float[ndarray, "n 3"], directions: Float[ndarray, "n 3"]) -> o3d.core.Tensor:
        return o3d.core.Tensor(np.concatenate([self._inside(origins), directions.astype(np.float32)], 1))
