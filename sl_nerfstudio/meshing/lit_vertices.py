"""The vertices of a mesh that a camera sees and a projector lights."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from numpy import ndarray

from sl_nerfstudio.compiled import compiled_range
from sl_nerfstudio.geometry.devices import Device, Intrinsics
from sl_nerfstudio.geometry.devices.compiled_view import view_of
from sl_nerfstudio.geometry.devices.models import MODELS
from sl_nerfstudio.meshing.loops.decoded_offset import CODE, EYE, HEIGHT, PARAMETERS, WIDTH, WORLD
from sl_nerfstudio.meshing.loops.derivatives import moved
from sl_nerfstudio.meshing.mesh import Mesh


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
        self._scene.cast_rays(
            o3d.core.Tensor(np.zeros((1, 6), np.float32))
        )  # builds the index, before threads share it

    def hidden(
        self,
        points: Float[ndarray, "v 3"],
        normals: Float[ndarray, "v 3"],
        chosen: Int64[ndarray, "n"],
        eye: Float[ndarray, "3"],
    ) -> Bool[ndarray, "n"]:
        """Whether the mesh is between `eye` and some points on the mesh, all of which face `eye`.

        Rays start two edge lengths away from the surface, along the normal and towards the eye, so that they do not hit
        the triangles they start from.
        """
        rays = np.empty((len(chosen), 6), np.float32)
        _write_rays(len(chosen), points, normals, chosen, eye, self._start, self._centre, self._scale, rays)
        return self._scene.test_occlusions(self._o3d.core.Tensor(rays), tnear=0.0, tfar=1.0).numpy()


@dataclass(frozen=True)
class LitVertices:
    """Vertices that a frame should see and light, and where."""

    vertex: Int64[ndarray, "m"]
    uv: Float[ndarray, "m 2 2"]  # camera pixels and pattern pixels


def lit_vertices(
    vertices: Float[ndarray, "v 3"],
    normals: Float[ndarray, "v 3"],
    chosen: Int64[ndarray, "c"],
    occluder: Occluder,
    camera: Device,
    projector: Device,
    T_world_camera: Float[ndarray, "4 4"],
    T_world_projector: Float[ndarray, "4 4"],
) -> LitVertices:
    """Chosen vertices that face both devices, project into image and pattern, and are hidden from neither."""
    views = ((camera, T_world_camera), (projector, T_world_projector))
    packed = np.stack([packed_device(device, T) for device, T in views])
    uv, faces = np.empty((len(chosen), 2, 2)), np.empty(len(chosen), np.bool_)
    _project_facing(len(chosen), vertices, normals, chosen, packed, uv, faces)
    left = np.flatnonzero(faces)
    for _, T in views:
        left = left[~occluder.hidden(vertices, normals, chosen[left], np.asarray(T[:3, 3], dtype=np.float64))]
    return LitVertices(chosen[left], uv[left])


def packed_device(device: Device, T_world_device: Float[ndarray, "4 4"]) -> Float[ndarray, "26"]:
    """A device for compiled loops: its pose's inverse, where it is, parameters, code, and size of the image."""
    T = np.asarray(T_world_device, dtype=np.float64)
    R, t = T[:3, :3], T[:3, 3]
    world = np.concatenate([R.T, -R.T @ t[:, None]], 1)
    numbers = [float(x) for x in (MODELS[device.model].code, device.w, device.h)]
    return np.concatenate([world.reshape(-1), t, Intrinsics.of(device, torch.float64).params.numpy(), numbers])


@compiled_range
def _project_facing(first, last, vertices, normals, chosen, devices, uv, faces):
    """Pixels `uv` (c, devices, 2) of chosen vertices; whether they face all devices (26 numbers) and are inside."""
    for i in range(first, last):
        faces[i] = True
        x, y, z = vertices[chosen[i]]
        a, b, c = normals[chosen[i]]
        for k in range(len(devices)):
            d = devices[k]
            if not (d[EYE] - x) * a + (d[EYE + 1] - y) * b + (d[EYE + 2] - z) * c > 0:
                faces[i] = False
                break
        if not faces[i]:
            continue
        for k in range(len(devices)):
            d = devices[k]
            X, Y, Z = moved(d, WORLD, x, y, z)
            found = view_of(d[CODE], X, Y, Z, d[PARAMETERS:CODE])
            u, v = found[0], found[1]
            uv[i, k, 0], uv[i, k, 1] = u, v
            if not (found[2] and 0 <= u < d[WIDTH] and 0 <= v < d[HEIGHT]):
                faces[i] = False
                break


@compiled_range
def _write_rays(first, last, points, normals, chosen, eye, start, centre, scale, rays):
    """Rays (n, 6) from beside chosen points of the surface to the eye, in units of `scale` around `centre`."""
    for i in range(first, last):
        j = chosen[i]
        x, y, z = eye[0] - points[j, 0], eye[1] - points[j, 1], eye[2] - points[j, 2]
        distance = (x * x + y * y + z * z) ** 0.5
        for k in range(3):
            begin = points[j, k] + start * (normals[j, k] + (eye[k] - points[j, k]) / distance)
            rays[i, k] = (begin - centre[k]) * scale
            rays[i, 3 + k] = (eye[k] - begin) * scale


def dot(a: Float[ndarray, "n k"], b: Float[ndarray, "n k"]) -> Float[ndarray, "n"]:
    """Dot products of rows; `(a * b).sum(1)` takes five times as long."""
    return np.einsum("nk,nk->n", a, b)
