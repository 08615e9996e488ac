"""A mesh with a search tree: nearest points, ray hits, samples, and which of its points a scan could observe."""

from collections.abc import Iterable
from dataclasses import dataclass, fields
from functools import cached_property, partial

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.geometry.triangulation import world_pixels
from sl_nerfstudio.late_imports import open3d as o3d
from sl_nerfstudio.meshing.mesh import Mesh, ray_scene
from sl_nerfstudio.parallel import compiled, results, split, threads
from sl_nerfstudio.scan import Scan

# Triangles in float64: nearest points, neighbours, and which of them are long and thin.

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
        self._scene = ray_scene(self._inside(self.vertices), self.faces)

    def _inside(self, p: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
        return ((p - self.centre) * self._scale).astype(np.float32)

    def corners(self, face: Int[ndarray, "n"]) -> tuple[Float[ndarray, "n 3"], ...]:
        """The three corners of some triangles."""
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
        return self.mesh.face_cross()

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
        a, b, c = self.corners(face)
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
        foot = nearest_on_triangle(points, *self.corners(face))
        best = np.linalg.norm(points - foot, axis=1)
        near_thin = np.flatnonzero(self._by_thin[face])
        for other in self._neighbours[face[near_thin]].T:
            candidate = nearest_on_triangle(points[near_thin], *self.corners(other))
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

    def signed_distance(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        """Distance of each point from the surface, negative behind it (inside the object)."""
        near = self.closest(points)
        behind = ((points - near.point) * near.normal).sum(1) < 0
        return np.where(behind, -near.distance, near.distance)

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


@dataclass(frozen=True)
class CaptureView:
    """A camera with its projector, anywhere."""

    camera: Device
    T_world_camera: Float[ndarray, "4 4"]
    projector: Device
    T_world_projector: Float[ndarray, "4 4"]

    @property
    def devices(self) -> tuple[tuple[Device, Float[ndarray, "4 4"]], ...]:
        """Both devices with their poses, the camera first."""
        return (self.camera, self.T_world_camera), (self.projector, self.T_world_projector)


def capture_views(scan: Scan, poses: DevicePoses) -> list[CaptureView]:
    """The views of all frames of a scan."""
    every = zip(scan.frames, poses.T_world_camera, poses.T_world_projector, strict=True)
    return [CaptureView(frame.camera, T_c, scan.projector, T_p) for frame, T_c, T_p in every]


def observable(
    points: Float[ndarray, "m 3"], normals: Float[ndarray, "m 3"], surface: IndexedMesh, views: Iterable[CaptureView]
) -> Bool[ndarray, "m"]:
    """Whether in at least one view the camera sees a point while the projector lights it.

    Seen and lit mean: the surface faces the device, the point projects into its image, and no other part of the
    surface is in between.
    """
    seen = np.zeros(len(points), bool)
    for view in views:
        unseen = np.flatnonzero(~seen)
        for device, T in view.devices:
            unseen = unseen[faces_and_falls_inside(points[unseen], normals[unseen], device, T)]
            unseen = unseen[~surface.occluded(points[unseen], T[:3, 3])]
        seen[unseen] = True
    return seen


def faces_and_falls_inside(
    points: Float[ndarray, "m 3"], normals: Float[ndarray, "m 3"], device: Device, T_world_device: Float[ndarray, "4 4"]
) -> Bool[ndarray, "m"]:
    """Whether points with outward `normals` face the device and project into its image."""
    _, inside = world_pixels(device, T_world_device, points)
    facing = ((T_world_device[:3, 3] - points) * normals).sum(1) > 0
    return inside & facing
