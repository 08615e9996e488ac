"""Rays of a texture's pixels, for `ns-export` with its default `--texture-method nerf`.

nerfstudio compares every pixel of the texture with every triangle of the mesh: with its defaults (2048 x 2048 pixels,
50,000 triangles) hours without a GPU. Here each triangle is drawn into the texture: a second.
"""

import numpy as np
import torch
import xatlas
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor
from torch.nn import functional as F

from sl_nerfstudio.compiled import compiled

_GUTTER_PX = 2.0  # how far beside a triangle pixels get its colour: texture filters read beyond the edge
_CHARTS = 500
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
    corners, uv = _charts(v, f, n)
    triangle, weights = draw_triangles(uv[corners].astype(np.float64), num_pixels_per_side)
    covered = triangle >= 0
    origins = np.full((*triangle.shape, 3), _OUTSIDE, np.float32)
    directions = np.ones_like(origins)
    mine = f[triangle[covered]]
    origins[covered] = (weights[covered][..., None] * v[mine]).sum(1)
    directions[covered] = -(weights[covered][..., None] * n[mine]).sum(1)
    rays = [torch.from_numpy(x).to(vertices.device) for x in (origins, directions)]
    return torch.from_numpy(uv[corners]).to(vertices.device), rays[0], F.normalize(rays[1], dim=-1)


def _charts(
    v: Float[ndarray, "vertices 3"], f: Int[ndarray, "faces 3"], n: Float[ndarray, "vertices 3"]
) -> tuple[Int[ndarray, "faces 3"], Float[ndarray, "corners 2"]]:
    """The mesh laid out flat: for each face its corners, and their texture coordinates.

    xatlas needs 28 s for the 50,000 faces of a scan if its charts may be large, 4 s for at least 500 charts.
    """
    area = 0.5 * np.linalg.norm(np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]]), axis=1).sum()
    atlas, options = xatlas.Atlas(), xatlas.ChartOptions()
    options.max_chart_area = float(area) / _CHARTS
    atlas.add_mesh(v, f, n)
    atlas.generate(chart_options=options)
    _, corners, uv = atlas[0]
    return corners.astype(np.int64), uv


def draw_triangles(
    corners: Float[ndarray, "faces 3 2"], size: int
) -> tuple[Int[ndarray, "size size"], Float[ndarray, "size size 3"]]:
    """The triangle at every pixel of a square texture, -1 where there is none, and its barycentric weights there.

    `corners` are in [0, 1], x to the right and y down; pixel centres are at (i + 0.5) / size. Pixels up to two pixels
    beside a triangle belong to it, unless they are inside another one; their weights continue its plane.
    """
    triangle = np.full((size, size), -1, np.int32)
    weights = np.zeros((size, size, 3), np.float32)
    outside = np.full((size, size), np.inf, np.float32)
    _draw(corners * size, triangle, weights, outside)
    return triangle, weights


@compiled
def _draw(corners: ndarray, triangle: ndarray, weights: ndarray, outside: ndarray) -> None:
    """`outside`: how far, in pixels, a pixel is from the triangle it belongs to, measured across its edges."""
    size = len(triangle)
    for k in range(len(corners)):
        (ax, ay), (bx, by), (cx, cy) = corners[k]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0:
            continue
        # a weight of -1 is one height of the triangle beyond an edge
        height_a = abs(area) / max(np.hypot(cx - bx, cy - by), 1e-12)
        height_b = abs(area) / max(np.hypot(ax - cx, ay - cy), 1e-12)
        height_c = abs(area) / max(np.hypot(bx - ax, by - ay), 1e-12)
        first_x = max(int(min(ax, bx, cx) - _GUTTER_PX), 0)
        first_y = max(int(min(ay, by, cy) - _GUTTER_PX), 0)
        last_x = min(int(max(ax, bx, cx) + _GUTTER_PX), size - 1)
        last_y = min(int(max(ay, by, cy) + _GUTTER_PX), size - 1)
        for row in range(first_y, last_y + 1):
            for column in range(first_x, last_x + 1):
                x, y = column + 0.5, row + 0.5
                a = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                b = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                c = 1.0 - a - b
                beside = max(-a * height_a, -b * height_b, -c * height_c, 0.0)
                if beside <= _GUTTER_PX and beside < outside[row, column]:
                    outside[row, column] = beside
                    triangle[row, column] = k
                    weights[row, column] = (a, b, c)
