"""Meshes with known geometry."""

import numpy as np
import open3d as o3d

from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.meshing.mesh import Mesh


def sphere(radius: float = 1.0, resolution: int = 60) -> Mesh:
    """Sphere about the origin, outward triangles."""
    return from_open3d(o3d.geometry.TriangleMesh.create_sphere(radius, resolution))


def blob(resolution: int = 40) -> Mesh:
    """A lopsided closed shape of about size 2: no rotation or scale maps it onto itself."""
    mesh = sphere(1.0, resolution)
    x, y, z = mesh.vertices.T
    radius = 1 + 0.25 * x * y + 0.2 * z**3 + 0.15 * x**2 - 0.1 * y
    return Mesh(mesh.vertices * radius[:, None] * np.array([1.0, 0.8, 0.6]), mesh.faces)


def from_open3d(mesh: o3d.geometry.TriangleMesh) -> Mesh:
    """Open3D's mesh as ours."""
    return Mesh(np.asarray(mesh.vertices).copy(), np.asarray(mesh.triangles).astype(np.int64))


def turn(axis: tuple[float, float, float], degrees: float) -> np.ndarray:
    """Rotation matrix."""
    from scipy.spatial.transform import Rotation

    unit = np.array(axis) / np.linalg.norm(axis)
    return Rotation.from_rotvec(np.radians(degrees) * unit).as_matrix()


def known_similarity() -> Similarity:
    """A moderate map: 4 % larger, turned by 6 degrees, shifted by a tenth of the shape."""
    return Similarity(1.04, turn((1.0, 2.0, -0.5), 6.0), np.array([0.08, -0.1, 0.05]))
