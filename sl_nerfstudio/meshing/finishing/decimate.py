"""Fewer triangles by quadric edge collapse (Garland and Heckbert, SIGGRAPH 1997), and what that changed."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from sl_nerfstudio.meshing.finishing.closest import ClosestSurface
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
    found = ClosestSurface(mesh).closest(fewer.vertices)
    back = ClosestSurface(fewer).closest(mesh.vertices).distance
    return Decimated(
        fewer,
        mesh.faces[found.triangle, found.weights.argmax(1)],
        found.distance,
        len(mesh.faces),
        float(np.sqrt((back**2).mean())),
        float(max(back.max(), found.distance.max())),
    )
