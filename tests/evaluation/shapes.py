"""Meshes with known geometry, nominal parts with fine surfaces, and what a scanner makes of them."""

import numpy as np
import open3d as o3d
import trimesh
from scipy.spatial.transform import Rotation

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
    unit = np.array(axis) / np.linalg.norm(axis)
    return Rotation.from_rotvec(np.radians(degrees) * unit).as_matrix()


def known_similarity() -> Similarity:
    """A moderate map: 4 % larger, turned by 6 degrees, shifted by a tenth of the shape."""
    return Similarity(1.04, turn((1.0, 2.0, -0.5), 6.0), np.array([0.08, -0.1, 0.05]))


ANYWHERE = Similarity(1.0, turn((0.3, -1.0, 0.8), 131.0), np.array([310.0, -45.0, 20.0]))


def bracket() -> Mesh:
    """An L of 60 x 40 x 30 with walls of 10: no motion maps it onto itself."""
    corners = np.array([[0.0, 0], [60, 0], [60, 10], [10, 10], [10, 40], [0, 40]])
    low, high = (np.column_stack([corners, np.full(6, z)]) for z in (0.0, 30.0))
    flat = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    sides = [[k, (k + 1) % 6, (k + 1) % 6 + 6] for k in range(6)] + [[k, (k + 1) % 6 + 6, k + 6] for k in range(6)]
    return Mesh(np.concatenate([low, high]), np.concatenate([flat[:, ::-1], flat + 6, sides]).astype(np.int64))


def scanned(part: Mesh, edge: float = 2.5, noise: float = 0.02, S: Similarity = ANYWHERE, seed: int = 0) -> Mesh:
    """The part with fine triangles, each vertex off by some noise along its normal, anywhere."""
    vertices, faces, *_ = trimesh.remesh.subdivide_to_size(part.vertices, part.faces, edge)
    fine = Mesh(vertices, faces.astype(np.int64))
    off = np.random.default_rng(seed).normal(0, noise, len(vertices))
    return Mesh(vertices + off[:, None] * fine.vertex_normals(), fine.faces).mapped(S)


def facing(mesh: Mesh, direction: np.ndarray) -> Mesh:
    """The triangles that face a direction: what is seen from there."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return mesh.with_faces(np.cross(b - a, c - a) @ direction > 0)
