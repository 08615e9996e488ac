"""A mesh laid out flat: pieces of it (charts) side by side in a square."""

import numpy as np
import xatlas
from jaxtyping import Float, Int, Int64
from numpy import ndarray

from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.texture.texture import Charts

MANY_CHARTS = 500
"""At least so many: 50,000 triangles of a scan take 4 s then, and 28 s if charts may be large."""

_PIECE = (
    30000  # triangles that xatlas gets at once: 526,000 take 32 s then, on one thread (whole: 54 s), and it has several
)
_CHART_PX = 40.0  # side of a chart on average, if there are fewer: the padding takes most of the room of smaller ones
_FILLED = 0.6  # share of the square that charts cover, as a first guess of their scale
_PADDING_PX = 4  # between charts, so that filters of textures do not read across; about that after the square is filled


def square_charts(mesh: Mesh, size: int) -> Charts:
    """Charts in a square image of `size` pixels, with room for gutters; all at the scale that fills it."""
    area = max(float(mesh.face_areas().sum()), 1e-300)
    texel = (_FILLED * size**2 / area) ** 0.5  # xatlas takes triangles below 1e-7 for degenerate: pixels are its unit
    packing = xatlas.PackOptions()
    packing.texels_per_unit, packing.padding = 1.0, _PADDING_PX
    charts = min(max(_FILLED * (size / _CHART_PX) ** 2, 1.0), MANY_CHARTS)
    v = (mesh.vertices - mesh.vertices.mean(0)) * texel
    return laid_out(v, mesh.faces, mesh.vertex_normals(), area * texel**2 / charts, packing)


def laid_out(
    vertices: Float[ndarray, "v 3"],
    faces: Int[ndarray, "f 3"],
    normals: Float[ndarray, "v 3"],
    largest_area: float,
    packing: xatlas.PackOptions,
) -> Charts:
    """xatlas's charts of up to `largest_area`; the longer side of its atlas becomes 1."""
    atlas, options = xatlas.Atlas(), xatlas.ChartOptions()
    options.max_chart_area = largest_area
    pieces = _pieces(vertices[faces].mean(1), np.arange(len(faces)))
    used = []
    for piece in pieces:
        own, corners = np.unique(faces[piece], return_inverse=True)
        corners = corners.reshape(-1, 3).astype(np.uint32)
        atlas.add_mesh(vertices[own].astype(np.float32), corners, normals[own].astype(np.float32))
        used.append(own)
    atlas.generate(chart_options=options, pack_options=packing)
    corners, uv, vertex = np.empty((len(faces), 3), np.int64), [np.empty((0, 2), np.float32)], [np.empty(0, np.int64)]
    for k, (piece, own) in enumerate(zip(pieces, used, strict=True)):
        of_corner, of_face, uv_of_corner = atlas[k]
        corners[piece] = of_face.astype(np.int64) + sum(map(len, vertex))
        vertex.append(own[of_corner].astype(np.int64))
        uv.append(uv_of_corner)
    sides = np.array([atlas.width, atlas.height], np.float32)
    return Charts(corners, np.concatenate(uv) * (sides / sides.max()), np.concatenate(vertex), atlas.chart_count)


def _pieces(centres: Float[ndarray, "f 3"], some: Int64[ndarray, "p"]) -> list[Int64[ndarray, "_"]]:
    """Groups of triangles, ascending: halves along the longest side of their box, until they are small."""
    if len(some) <= _PIECE:
        return [np.sort(some)]
    axis = int(np.ptp(centres[some], axis=0).argmax())
    order = some[np.argsort(centres[some, axis], kind="stable")]
    half = len(order) // 2
    return [*_pieces(centres, order[:half]), *_pieces(centres, order[half:])]
