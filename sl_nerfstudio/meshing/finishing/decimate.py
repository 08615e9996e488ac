"""Fewer triangles by quadric edge collapse (Garland and Heckbert, SIGGRAPH 1997), and what that changed."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from sl_nerfstudio.meshing.mesh import Mesh

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
    from sl_nerfstudio.geometry.open3d_core import open3d as o3d

    centre, scale = mesh.vertices.mean(0), max(float(np.ptp(mesh.vertices, axis=0).max()), 1e-300)
    fewer = mesh
    if len(mesh.faces) > triangles:
        before = o3d.geometry.TriangleMesh(
            o3d.utility.Vector3dVector((mesh.vertices - centre) / scale),
            o3d.utility.Vector3iVector(mesh.faces.astype(np.int32)),
        )
        after = before.simplify_quadric_decimation(triangles, boundary_weight=_BORDERS)
        fewer = Mesh(np.asarray(after.vertices) * scale + centre, np.asarray(after.triangles).astype(np.int64))
        fewer = fewer.with_faces(np.ones(len(fewer.faces), dtype=bool))
    distance, triangle, corner = _closest(mesh, fewer.vertices, centre, scale)
    back, _, _ = _closest(fewer, mesh.vertices, centre, scale)
    return Decimated(
        fewer,
        mesh.faces[triangle, corner],
        distance,
        len(mesh.faces),
        float(np.sqrt((back**2).mean())),
        float(max(back.max(), distance.max())),
    )


def _closest(
    mesh: Mesh, points: Float64[ndarray, "n 3"], centre: Float64[ndarray, "3"], scale: float
) -> tuple[Float64[ndarray, "n"], Int64[ndarray, "n"], Int64[ndarray, "n"]]:
    """Distance of points from a surface, the nearest triangle, and which of its corners (0, 1, 2) is nearest."""
    from sl_nerfstudio.geometry.open3d_core import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    vertices = ((mesh.vertices - centre) / scale).astype(np.float32)
    scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
    found = scene.compute_closest_points(o3d.core.Tensor(((points - centre) / scale).astype(np.float32)))
    triangle = found["primitive_ids"].numpy().astype(np.int64)
    u, v = found["primitive_uvs"].numpy().T
    distance = np.linalg.norm(points - (found["points"].numpy() * scale + centre), axis=1).astype(np.float64)
    return distance, triangle, np.stack([1 - u - v, u, v], 1).argmax(1)
