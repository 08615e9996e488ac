"""Nominal parts with fine surfaces, and what a scanner makes of them."""

import numpy as np
import trimesh

from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.meshing.mesh import Mesh

from .shapes import turn

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
