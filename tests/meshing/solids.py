"""Meshes of known shape, and several of them as one."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
import trimesh

from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.meshing.extract import extract_mesh
from sl_nerfstudio.meshing.mesh import Mesh


def mesh_of(solid: trimesh.Trimesh, scale: float = 1.0) -> Mesh:
    """A mesh of trimesh as ours."""
    return Mesh(np.asarray(solid.vertices, dtype=np.float64) * scale, np.asarray(solid.faces, dtype=np.int64))


def extracted(
    distance: Callable[[torch.Tensor], torch.Tensor], cells: int, half: float, centre: Sequence[float] = (0.0, 0.0, 0.0)
) -> Mesh:
    """The zero level of a distance in a cube about a centre."""
    middle = torch.tensor(centre)
    box = Similarity(half, np.eye(3), np.array(centre))
    return extract_mesh(lambda p: distance(half * p + middle) / half, cells).mapped(box)


def ball(centre: Sequence[float], radius: float, cell: float = 1.5) -> Mesh:
    """A ball of cells of about one size."""
    half, middle = radius + 2 * cell, torch.tensor(centre)
    return extracted(lambda p: (p - middle).norm(dim=-1) - radius, round(2 * half / cell), half, centre)


def together(*parts: Mesh) -> Mesh:
    """All parts as one mesh, their vertices in the order of the parts."""
    offsets = np.cumsum([0, *(len(p.vertices) for p in parts)])[:-1]
    faces = [p.faces + offset for p, offset in zip(parts, offsets, strict=True)]
    return Mesh(np.concatenate([p.vertices for p in parts]), np.concatenate(faces))


def plate(half: float, cell: float, z: float = 0.0) -> Mesh:
    """A square at a height z, seen from above."""
    n = int(2 * half / cell) + 1
    x, y = np.meshgrid(np.linspace(-half, half, n), np.linspace(-half, half, n))
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1, 1)
    faces = np.concatenate([i + np.array([0, 1, n]), i + np.array([1, n + 1, n])])
    return Mesh(np.stack([x.ravel(), y.ravel(), np.full(n * n, z)], 1), faces)


def triangles_at_edges(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """All edges (e, 2), each once, and how many triangles each has."""
    return np.unique(np.sort(mesh.edges(), axis=1), axis=0, return_counts=True)
