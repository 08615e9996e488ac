"""The points of a surface that are closest to given ones."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from sl_nerfstudio.meshing.mesh import Mesh


@dataclass(frozen=True)
class ClosestPoints:
    """For each given point the closest one of a mesh; lengths in the mesh's unit."""

    distance: Float64[ndarray, "n"]
    triangle: Int64[ndarray, "n"]
    weights: Float64[ndarray, "n 3"]  # of the triangle's corners, to single precision


class ClosestSurface:
    """A mesh, prepared to be asked for closest points."""

    def __init__(self, mesh: Mesh) -> None:
        """`mesh` may be open."""
        from sl_nerfstudio.geometry.open3d_core import open3d as o3d

        self._o3d = o3d
        self._centre = mesh.vertices.mean(0)
        self._scale = max(float(np.ptp(mesh.vertices, axis=0).max()), 1e-300)
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(self._scaled(mesh.vertices), o3d.core.Tensor(mesh.faces.astype(np.uint32)))

    def _scaled(self, points: Float64[ndarray, "n 3"]) -> object:
        return self._o3d.core.Tensor(((points - self._centre) / self._scale).astype(np.float32))

    def closest(self, points: Float64[ndarray, "n 3"]) -> ClosestPoints:
        """Of every point."""
        found = self._scene.compute_closest_points(self._scaled(points))
        u, v = found["primitive_uvs"].numpy().T.astype(np.float64)
        there = found["points"].numpy() * self._scale + self._centre
        return ClosestPoints(
            np.linalg.norm(points - there, axis=1).astype(np.float64),
            found["primitive_ids"].numpy().astype(np.int64),
            np.stack([1 - u - v, u, v], 1),
        )
