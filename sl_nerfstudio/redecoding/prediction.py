"""What a surface and the poses of a frame say that each pixel of the frame sees of the pattern."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device, Intrinsics
from sl_nerfstudio.geometry.rays import pixel_centres, pixel_rays, world_pixels
from sl_nerfstudio.meshing.mesh import Mesh

_PUSH = 1e-4  # of the depth: how far a point is moved along its ray to see where its coordinate goes
_OWN = 2.0  # edge lengths: a hit this close before a point is the surface on which the point lies


@dataclass(frozen=True)
class Prediction:
    """What each pixel of a frame should see; NaN where it sees no surface that the projector lights."""

    coords: Float32[ndarray, "h w 2"]  # pattern pixels
    along: Float32[ndarray, "h w 2"]  # unit direction in which a coordinate moves with the depth of its point
    depth: Float32[ndarray, "h w"]  # distance from the camera over the focal length: the width of a pixel there

    @property
    def known(self) -> Bool[ndarray, "h w"]:
        """Pixels that have a prediction."""
        return np.isfinite(self.coords).all(-1)


class Surface:
    """A mesh that rays are cast at."""

    def __init__(self, mesh: Mesh) -> None:
        """`mesh` may be open; both of its sides are seen and give shade."""
        from sl_nerfstudio.geometry.open3d_core import open3d as o3d

        self._tensor = o3d.core.Tensor
        self._centre = mesh.vertices.mean(0)  # open3d computes in single precision
        self._scale = 1 / max(float(np.ptp(mesh.vertices, axis=0).max()), 1e-300)
        self._own = _OWN * mesh.edge_length()
        a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        self._normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        self._corner = a
        self._scene = o3d.t.geometry.RaycastingScene()
        vertices = ((mesh.vertices - self._centre) * self._scale).astype(np.float32)
        self._scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(mesh.faces.astype(np.uint32)))

    def predict(
        self,
        camera: Device,
        projector: Device,
        T_world_camera: Float[ndarray, "4 4"],
        T_world_projector: Float[ndarray, "4 4"],
    ) -> Prediction:
        """What the camera sees of the pattern that the projector throws on the surface."""
        uv = pixel_centres(camera, torch.float64).reshape(-1, 2)
        pose = torch.as_tensor(T_world_camera, dtype=torch.float64)
        direction = pixel_rays(Intrinsics.of(camera, torch.float64), pose, uv)[1].numpy()
        eye, lamp = np.asarray(T_world_camera[:3, 3]), np.asarray(T_world_projector[:3, 3])
        face, distance = self._first_hits(eye, direction)
        seen = np.flatnonzero(np.isfinite(distance))
        p_world = eye + distance[seen, None] * direction[seen]
        normal = self._normal[face[seen]]
        lit = _dot(eye - p_world, normal) * _dot(lamp - p_world, normal) > 0
        lit &= self._reached(lamp, p_world)
        seen, p_world = seen[lit], p_world[lit]
        place, inside = world_pixels(projector, T_world_projector, p_world)
        pushed, _ = world_pixels(projector, T_world_projector, p_world + _PUSH * distance[seen, None] * direction[seen])
        moved = pushed - place
        length = np.linalg.norm(moved, axis=1)
        inside &= length > 0
        n, seen = camera.h * camera.w, seen[inside]
        coords, along = np.full((2, n, 2), np.nan, dtype=np.float32)
        depth = np.full(n, np.nan, dtype=np.float32)
        coords[seen], along[seen] = place[inside], moved[inside] / length[inside, None]
        depth[seen] = distance[seen] / min(camera.fl_x, camera.fl_y)
        shape = (camera.h, camera.w)
        return Prediction(coords.reshape(*shape, 2), along.reshape(*shape, 2), depth.reshape(shape))

    def _first_hits(self, eye: Float[ndarray, "3"], direction: Float[ndarray, "n 3"]) -> tuple[ndarray, ndarray]:
        """Face, and distance to its plane in double precision (infinite without a hit), of unit rays."""
        answer = self._cast(eye, direction)
        face, hit = answer["primitive_ids"].numpy().astype(np.int64), np.isfinite(answer["t_hit"].numpy())
        distance = np.full(len(direction), np.inf)
        normal, corner = self._normal[face[hit]], self._corner[face[hit]]
        distance[hit] = _dot(corner - eye, normal) / _dot(direction[hit], normal)
        return face, distance

    def _reached(self, lamp: Float[ndarray, "3"], p_world: Float[ndarray, "n 3"]) -> Bool[ndarray, "n"]:
        """Whether nothing but the surface around a point is between it and the projector."""
        way = p_world - lamp
        length = np.linalg.norm(way, axis=1)
        first = self._cast(lamp, way / length[:, None])["t_hit"].numpy() / self._scale
        return first > length - self._own

    def _cast(self, origin: Float[ndarray, "3"], direction: Float[ndarray, "n 3"]) -> dict:
        rays = np.empty((len(direction), 6), dtype=np.float32)
        rays[:, :3], rays[:, 3:] = (origin - self._centre) * self._scale, direction
        return self._scene.cast_rays(self._tensor(rays))


def _dot(a: Float[ndarray, "n k"], b: Float[ndarray, "n k"]) -> Float[ndarray, "n"]:
    return np.einsum("nk,nk->n", a, b)
