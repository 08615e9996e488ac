"""The vertices of a mesh that a camera sees and a projector lights."""

from dataclasses import dataclass, fields
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Int64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.rays import world_pixels
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.threads import results, split, threads


class Occluder:
    """Finds out whether a mesh hides its own vertices from a device."""

    def __init__(self, mesh: Mesh) -> None:
        """`mesh` may be open; both of its sides hide what is behind them."""
        from sl_nerfstudio.geometry.open3d_core import open3d as o3d

        self._o3d = o3d
        self._centre = mesh.vertices.mean(0)
        self._scale = 1 / max(float(np.ptp(mesh.vertices, axis=0).max()), 1e-300)
        self._start = 2 * mesh.edge_length()
        self._scene = o3d.t.geometry.RaycastingScene()
        vertices = ((mesh.vertices - self._centre) * self._scale).astype(np.float32)
        self._scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(mesh.faces.astype(np.uint32)))

    def hidden(
        self, points: Float[ndarray, "n 3"], normals: Float[ndarray, "n 3"], eye: Float[ndarray, "3"]
    ) -> Bool[ndarray, "n"]:
        """Whether the mesh is between `eye` and points on the mesh that face `eye`.

        Rays start two edge lengths away from the surface, along the normal and towards the eye, so that they do not hit
        the triangles they start from.
        """
        way = eye - points
        distance = np.sqrt(dot(way, way))[:, None]
        start = points + self._start * (normals + way / distance)
        rays = np.concatenate([(start - self._centre) * self._scale, (eye - start) * self._scale], 1).astype(np.float32)
        return self._scene.test_occlusions(self._o3d.core.Tensor(rays), tnear=0.0, tfar=1.0).numpy()


@dataclass(frozen=True)
class LitVertices:
    """Vertices that a frame should see and light, and where."""

    vertex: Int64[ndarray, "m"]
    uv_camera: Float[ndarray, "m 2"]  # camera pixels
    uv_projector: Float[ndarray, "m 2"]  # pattern pixels


def lit_vertices(
    vertices: Float[ndarray, "v 3"],
    normals: Float[ndarray, "v 3"],
    occluder: Occluder,
    camera: Device,
    projector: Device,
    T_world_camera: Float[ndarray, "4 4"],
    T_world_projector: Float[ndarray, "4 4"],
) -> LitVertices:
    """The vertices that face both devices and project into image and pattern, and that the mesh hides from neither."""
    views = ((camera, T_world_camera), (projector, T_world_projector))
    parts = results(
        [
            partial(_lit_part, vertices, normals, occluder, np.arange(first, last), *views)
            for first, last in split(len(vertices), threads(), 1)
        ]
    )
    return LitVertices(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(LitVertices)))


def _lit_part(
    vertices: Float[ndarray, "v 3"],
    normals: Float[ndarray, "v 3"],
    occluder: Occluder,
    vertex: Int64[ndarray, "n"],
    *views: tuple[Device, Float[ndarray, "4 4"]],
) -> LitVertices:
    """The same for the vertices numbered `vertex`."""
    for _, T in views:
        vertex = vertex[dot(T[:3, 3] - vertices[vertex], normals[vertex]) > 0]
    pixels: list[Float[ndarray, "n 2"]] = []
    for device, T in views:
        uv, inside = world_pixels(device, T, vertices[vertex])
        vertex, pixels = vertex[inside], [found[inside] for found in (*pixels, uv)]
    for _, T in views:
        free = ~occluder.hidden(vertices[vertex], normals[vertex], T[:3, 3])
        vertex, pixels = vertex[free], [found[free] for found in pixels]
    return LitVertices(vertex, *pixels)


def dot(a: Float[ndarray, "n k"], b: Float[ndarray, "n k"]) -> Float[ndarray, "n"]:
    """Dot products of rows; `(a * b).sum(1)` takes five times as long."""
    return np.einsum("nk,nk->n", a, b)
