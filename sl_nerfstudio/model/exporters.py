"""`ns-export` without a GPU: what takes hours or minutes there in nerfstudio, and how it takes seconds."""

import sys
from functools import partial
from typing import Any

import numpy as np
import torch
import xatlas
from jaxtyping import Float, Int, Int64
from numpy import ndarray
from torch import Tensor
from torch.nn import functional as F

from sl_nerfstudio.meshing.texture import MANY_CHARTS, draw_triangles, laid_out
from sl_nerfstudio.parallel import compiled_range, torch_on_one_thread

# An order of points in which neighbours in space are mostly neighbours in memory.

_BITS = 10  # of each coordinate
_SPREAD = ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249))
"""Shifts, and the bits that stay after each: the ten bits of a number end up three places apart."""


def spatial_order(p: Float[ndarray, "n 3"]) -> Int64[ndarray, "n"]:
    """Indices of points along Morton's curve (G. M. Morton 1966) through 1024^3 cells of their bounding cube.

    Searches for neighbours of points in this order find in the cache what they need: with a million points they take a
    sixth of the time that they take in random order.
    """
    low, side = p.min(0, initial=np.inf), float(np.ptp(p, axis=0).max(initial=0.0)) if len(p) else 0.0
    cell = ((p - low) * ((2**_BITS - 1) / max(side, 1e-300))).astype(np.int64)
    for shift, kept in _SPREAD:
        cell = (cell | cell << shift) & kept
    return np.argsort(cell[:, 0] | cell[:, 1] << 1 | cell[:, 2] << 2, kind="stable")


# Rays of a texture's pixels, for `ns-export` with its default `--texture-method nerf`.
#
# nerfstudio compares every pixel of the texture with every triangle of the mesh: with its defaults (2048 x 2048
# pixels,
# 50,000 triangles) hours without a GPU. Here each triangle is drawn into the texture: a second.

_OUTSIDE = 10.0  # scene units: rays of pixels without a triangle start here and lead away from the scene

Unwrapped = tuple[Float[Tensor, "faces 3 2"], Float[Tensor, "h w 3"], Float[Tensor, "h w 3"]]


def unwrap_mesh_with_xatlas(
    vertices: Float[Tensor, "vertices 3"],
    faces: Int[Tensor, "faces 3"],
    vertex_normals: Float[Tensor, "vertices 3"],
    num_pixels_per_side: int = 1024,
    num_faces_per_barycentric_chunk: int = 10,
) -> Unwrapped:
    """Stands in for nerfstudio's function of this name (exporter/texture_utils.py, 1.1.5): same arguments, same result.

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


_EXPORTER = "nerfstudio.scripts.exporter"


def quicken_exporters() -> None:
    """Called when a run is opened; does nothing in commands other than `ns-export`.

    - A texture's rays are found by drawing triangles; see texture_rays.py.
    - open3d's Poisson reconstruction runs in one thread. Its threads wait for each other in loops: 20,000 points at
      depth 6 took 0.5 s with one thread and more than 30 s with four, on four cores that were not idle.
    - So do torch's threads in nerfstudio's own loops over frames: beside other work, the rays of 22 frames took 27 s of
      processor time instead of 0.3, the sums of the TSDF 18 instead of 6. Torch gets one thread, our loops keep all.
    - Points of random pixels come in random order. open3d gets them sorted in space: of a million, it then searches
      outliers in 2 s instead of 10, and reconstructs in 14 s instead of 20.
    """
    exporter = sys.modules.get(_EXPORTER)
    if exporter is None:
        return
    torch_on_one_thread()
    exporter.texture_utils.unwrap_mesh_with_xatlas = unwrap_mesh_with_xatlas
    clouds, meshes = exporter.o3d.geometry.PointCloud, exporter.o3d.geometry.TriangleMesh
    poisson, without_outliers = meshes.create_from_point_cloud_poisson, clouds.remove_statistical_outlier
    if isinstance(poisson, partial):
        return
    meshes.create_from_point_cloud_poisson = partial(_poisson, poisson, n_threads=1)
    clouds.remove_statistical_outlier = lambda *given, **named: _without_outliers(without_outliers, *given, **named)


def _poisson(reconstruct: Any, cloud: Any, *given: Any, **named: Any) -> Any:
    return reconstruct(_sorted(cloud, spatial_order(np.asarray(cloud.points))), *given, **named)


def _without_outliers(remove: Any, cloud: Any, *given: Any, **named: Any) -> tuple[Any, list[int]]:
    """What open3d's method returns: the cloud that remains, and the indices of its points, both in the old order."""
    order = spatial_order(np.asarray(cloud.points))
    kept = np.sort(order[np.asarray(remove(_sorted(cloud, order), *given, **named)[1], dtype=np.int64)]).tolist()
    return cloud.select_by_index(kept), kept


def _sorted(cloud: Any, order: np.ndarray) -> Any:
    """A copy of open3d's cloud with its points, normals and colours in another order."""
    copy = type(cloud)()
    for name in ("points", "normals", "colors"):
        values = getattr(cloud, name)
        if len(values):
            setattr(copy, name, type(values)(np.asarray(values)[order]))
    return copy
