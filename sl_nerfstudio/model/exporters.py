"""`ns-export` without a GPU: what takes hours there in nerfstudio, in a second.

For its default `--texture-method nerf`, nerfstudio compares every pixel of the texture with every triangle of the mesh:
with its defaults (2048 x 2048 pixels, 50,000 triangles) hours without a GPU. Here each triangle is drawn into the
texture. nerfstudio offers no way to choose another function, so it is replaced, when `ns-export` opens a run.
"""

import sys
from functools import partial
from typing import Any

import numpy as np
import torch
import xatlas
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from sl_nerfstudio.meshing.texture import MANY_CHARTS, draw_triangles, laid_out
from sl_nerfstudio.parallel import compiled_range, torch_on_one_thread

_OUTSIDE = 10.0  # scene units: rays of pixels without a triangle start here and lead away from the scene

Unwrapped = tuple[Float[Tensor, "faces 3 2"], Float[Tensor, "h w 3"], Float[Tensor, "h w 3"]]


def unwrap_mesh_with_xatlas(
    vertices: Float[Tensor, "vertices 3"],
    faces: Int[Tensor, "faces 3"],
    vertex_normals: Float[Tensor, "vertices 3"],
    num_pixels_per_side: int = 1024,
    num_faces_per_barycentric_chunk: int = 10,
) -> Unwrapped:
    """Stand-in for nerfstudio's function of this name (exporter/texture_utils.py, 1.1.5): same arguments, same result.

    Returns the texture coordinates of every face's corners, and origin and unit direction (against the normal) of the
    ray of every texture pixel. Pixels that no triangle covers get a ray that misses the scene; nerfstudio gives them
    the ray of some triangle far away. The last argument has no meaning here.
    """
    v, f, n = (x.detach().cpu().numpy() for x in (vertices, faces, vertex_normals))
    area = 0.5 * np.linalg.norm(np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]]), axis=1).sum()
    charts = laid_out(v, f, n, float(area) / MANY_CHARTS, xatlas.PackOptions())
    corner_uv = charts.uv[charts.corners]
    triangle, weights = draw_triangles(corner_uv.astype(np.float64), num_pixels_per_side)
    origins = np.full((*triangle.shape, 3), _OUTSIDE, np.float32)
    directions = np.ones_like(origins)
    _write_rays(len(triangle), triangle, weights, f, v, n, origins, directions)
    rays = [torch.from_numpy(x).to(vertices.device) for x in (origins, directions)]
    return torch.from_numpy(corner_uv).to(vertices.device), rays[0], F.normalize(rays[1], dim=-1)


@compiled_range
def _write_rays(first, last, triangle, weights, faces, vertices, normals, origins, directions):
    """Fill origins and directions (h, w, 3) of the pixels that a triangle covers, in the rows of a range."""
    for row in range(first, last):
        for column in range(triangle.shape[1]):
            face = triangle[row, column]
            if face < 0:
                continue
            a, b, c = faces[face]
            x, y, z = weights[row, column]
            for k in range(3):
                origins[row, column, k] = x * vertices[a, k] + y * vertices[b, k] + z * vertices[c, k]
                directions[row, column, k] = -(x * normals[a, k] + y * normals[b, k] + z * normals[c, k])


def quicken_exporters() -> None:
    """Let `ns-export` find a texture's rays by drawing triangles; does nothing in other commands.

    Torch, and open3d's Poisson reconstruction, get one thread: theirs wait for each other in loops. Beside other work,
    20,000 points at depth 6 took more than 30 s with four threads instead of 0.5, and the rays of 22 frames 27 s.
    """
    exporter: Any = sys.modules.get("nerfstudio.scripts.exporter")
    if exporter is None:
        return
    torch_on_one_thread()
    exporter.texture_utils.unwrap_mesh_with_xatlas = unwrap_mesh_with_xatlas
    meshes = exporter.o3d.geometry.TriangleMesh
    poisson = meshes.create_from_point_cloud_poisson
    if not isinstance(poisson, partial):
        meshes.create_from_point_cloud_poisson = partial(poisson, n_threads=1)
