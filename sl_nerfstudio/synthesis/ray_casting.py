"""First hits of rays on a mesh: found by open3d in single precision, refined in double precision."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int, Int64
from numpy import ndarray

from sl_nerfstudio.synthesis.scenes.scene import Scene
from sl_nerfstudio.synthesis.scenes.surroundings import joined

_SAME_POINT = 2e-5  # of the distance: a hit this close to a point is the point


@dataclass(frozen=True)
class Hits:
    """First hit of each ray; `face` is -1, and the point NaN, where there is none."""

    face: Int64[ndarray, "n"]
    p_world: Float64[ndarray, "n 3"]


class RayCaster:
    """Casts rays at an object and its surroundings; lengths in millimetres."""

    def __init__(self, scene: Scene, surroundings: Scene | None = None) -> None:
        """Build the search tree of one mesh; in `self.scene` the object's faces come before its surroundings'."""
        from sl_nerfstudio.geometry.open3d_core import open3d as o3d

        self._object_faces = len(scene.faces)
        scene = scene if surroundings is None else joined(scene, surroundings)
        self.scene = scene
        self._tensor = o3d.core.Tensor
        self._tree = o3d.t.geometry.RaycastingScene()
        self._tree.add_triangles(
            o3d.core.Tensor(scene.vertices.astype(np.float32)), o3d.core.Tensor(scene.faces.astype(np.uint32))
        )

    def on_object(self, face: Int[ndarray, "n"]) -> Bool[ndarray, "n"]:
        """Whether faces belong to the object; false for surroundings, and where nothing is hit."""
        return (face >= 0) & (face < self._object_faces)

    def first_hits(self, origin: Float[ndarray, "3"], direction: Float[ndarray, "n 3"]) -> Hits:
        """What unit rays from one place hit first.

        open3d finds the face; the point on its plane is computed in double precision.
        """
        face, _ = self._cast(origin, direction)
        p_world = np.full(direction.shape, np.nan)
        hit = face >= 0
        normal = self.scene.face_normals[face[hit]]
        corner = self.scene.vertices[self.scene.faces[face[hit], 0]]
        along = ((corner - origin) * normal).sum(-1) / (direction[hit] * normal).sum(-1)
        p_world[hit] = origin + along[:, None] * direction[hit]
        return Hits(face, p_world)

    def sees(
        self, origin: Float[ndarray, "3"], p_world: Float[ndarray, "n 3"], face: Int[ndarray, "n"]
    ) -> Bool[ndarray, "n"]:
        """Whether nothing is between `origin` and points on the given faces."""
        ray = p_world - origin
        distance = np.linalg.norm(ray, axis=-1)
        seen_face, seen_distance = self._cast(origin, ray / distance[:, None])
        return (seen_face == face) | (seen_distance >= distance * (1 - _SAME_POINT))

    def _cast(
        self, origin: Float[ndarray, "3"], direction: Float[ndarray, "n 3"]
    ) -> tuple[Int64[ndarray, "n"], Float64[ndarray, "n"]]:
        rays = np.empty((len(direction), 6), dtype=np.float32)
        rays[:, :3], rays[:, 3:] = origin, direction
        answer = self._tree.cast_rays(self._tensor(rays))
        face = answer["primitive_ids"].numpy().astype(np.int64)
        distance = answer["t_hit"].numpy().astype(np.float64)
        return np.where(np.isfinite(distance), face, -1), distance
