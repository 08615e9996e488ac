"""What rays meet: the object and its surroundings, with colours from formulas. Lengths in mm, z is up."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import open3d as o3d
import trimesh
from numpy import ndarray

from benchmarks.another_renderer.optics import dots

EPSILON = 0.02  # mm by which shadow rays start off a surface


@dataclass(frozen=True)
class Hits:
    """What rays met first; `depth` is infinite where they met nothing."""

    depth: ndarray
    p_world: ndarray
    normal: ndarray
    is_object: ndarray


class Scene:
    """One object and what surrounds it, for one thread."""

    def __init__(self, thing: trimesh.Trimesh, others: list[trimesh.Trimesh]) -> None:
        self._caster: Any = o3d.t.geometry.RaycastingScene(nthreads=1)
        self._normals: list[ndarray] = []
        self._faces: list[ndarray] = []
        for mesh in (thing, *others):
            faces = np.asarray(mesh.faces, dtype=np.uint32)
            self._caster.add_triangles(np.asarray(mesh.vertices, dtype=np.float32), faces)
            # flat surroundings keep their facets' normals; of the object, whose facets are fine, they are interpolated
            self._normals.append(
                np.asarray(mesh.vertex_normals if mesh is thing else mesh.face_normals, dtype=np.float32)
            )
            self._faces.append(faces)

    def hits(self, origin: ndarray, directions: ndarray) -> Hits:
        """First hits of rays (n, 3) from one point, or from one each."""
        rays = np.concatenate([np.broadcast_to(origin, directions.shape), directions], -1).astype(np.float32)
        found = {key: value.numpy() for key, value in self._caster.cast_rays(o3d.core.Tensor(rays), nthreads=1).items()}
        depth, which, face, uv = found["t_hit"], found["geometry_ids"], found["primitive_ids"], found["primitive_uvs"]
        normal = np.zeros_like(directions)
        for number, (normals, faces) in enumerate(zip(self._normals, self._faces, strict=True)):
            chosen = which == number
            if number == 0:
                a, b, c = (normals[faces[face[chosen], k]] for k in range(3))
                u, v = uv[chosen, :1], uv[chosen, 1:]
                normal[chosen] = a * (1 - u - v) + b * u + c * v
            else:
                normal[chosen] = normals[face[chosen]]
        normal /= np.maximum(np.sqrt(dots(normal, normal)), 1e-9)[:, None]
        normal[dots(normal, directions) > 0] *= -1
        points = origin + np.where(np.isfinite(depth), depth, 0)[:, None] * directions
        return Hits(depth, points, normal, which == 0)

    def sees(self, p_world: ndarray, eye: ndarray) -> ndarray:
        """Whether nothing lies between points (n, 3) and `eye`."""
        rays = np.concatenate([p_world, eye - p_world], -1).astype(np.float32)  # the eye is at 1 along each ray
        return ~self._caster.test_occlusions(o3d.core.Tensor(rays), 0.0, 1.0, nthreads=1).numpy()


def surroundings(kind: str, thing: trimesh.Trimesh, rng: np.random.Generator) -> list[trimesh.Trimesh]:
    """Nothing ("none"), a table below the object, or a room with a table, walls and clutter."""
    if kind == "none":
        return []
    low, high = thing.bounds
    size, floor = float((high - low).max()), float(low[2])
    table = _at(trimesh.creation.box((9 * size, 9 * size, 8)), (0, 0, floor - 4))
    if kind == "table":
        return [table]
    walls = []
    for angle in (20.0, 115.0, 200.0, 290.0):
        wall = trimesh.creation.box((10, 12 * size, 7 * size))
        turn = np.radians(angle + rng.uniform(-8, 8))
        wall.apply_transform(trimesh.transformations.rotation_matrix(turn, (0, 0, 1)))
        walls.append(_at(wall, (4.6 * size * np.cos(turn), 4.6 * size * np.sin(turn), floor + 2 * size)))
    clutter = []
    for k in range(6):
        angle, far = np.radians(60 * k + rng.uniform(-20, 20)), rng.uniform(0.95, 1.3) * size
        a, b, c = rng.uniform(0.12, 0.34, 3) * size
        made = (trimesh.creation.box((a, b, c)), trimesh.creation.cylinder(a / 2, c), trimesh.creation.cone(a / 2, c))[
            k % 3
        ]
        made.apply_transform(trimesh.transformations.rotation_matrix(rng.uniform(0, 6.3), (0, 0, 1)))
        clutter.append(_at(made, (far * np.cos(angle), far * np.sin(angle), floor - float(made.bounds[0, 2]))))
    return [table, *walls, *clutter]


def _at(mesh: trimesh.Trimesh, shift: tuple[float, float, float]) -> trimesh.Trimesh:
    mesh.apply_translation(shift)
    return mesh


@dataclass(frozen=True)
class Paint:
    """Colours of surfaces: clouds of several sizes, and printed spots."""

    waves: ndarray  # (n, 3) radian per mm
    phases: ndarray  # (n,)
    strength: float  # 0: one grey
    tints: ndarray  # (2, 3) colours that are mixed
    spots: bool

    @staticmethod
    def random(strength: float, spots: bool, colour: bool, rng: np.random.Generator) -> "Paint":
        """Clouds from 8 to 80 mm."""
        directions = rng.normal(size=(14, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        waves = directions * (2 * np.pi / np.geomspace(8, 80, 14))[:, None]
        tints = rng.uniform(0.45, 0.95, (2, 3)) if colour else np.repeat(rng.uniform(0.6, 0.85, (2, 1)), 3, 1)
        return Paint(waves, rng.uniform(0, 2 * np.pi, 14), strength, tints, spots)

    def albedo(self, p_world: ndarray) -> ndarray:
        """(n, 3) of points (n, 3)."""
        p = p_world.astype(np.float32)
        waves = np.cos(p @ self.waves.T.astype(np.float32) + self.phases.astype(np.float32))
        clouds = np.clip(0.5 + 0.22 * waves[:, 4:].sum(1), 0, 1)[:, None]
        colour = self.tints[0] * clouds + self.tints[1] * (1 - clouds)
        shade = 1 - self.strength * np.clip(0.4 + 0.25 * waves[:, :8].sum(1), 0, 1)[:, None]
        if self.spots:
            shade = np.where((waves[:, 2] + waves[:, 5] + waves[:, 7] > 1.1)[:, None], shade * 0.45, shade)
        return colour * shade
