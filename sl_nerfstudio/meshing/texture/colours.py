"""An image of a surface's colours, from captures that were also taken without the pattern."""

import time
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int, UInt8
from numpy import ndarray

from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.meshing.finishing.closest import ClosestSurface
from sl_nerfstudio.meshing.lit_vertices import Occluder
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.texture.charts import square_charts
from sl_nerfstudio.meshing.texture.drawing import draw_triangles
from sl_nerfstudio.meshing.texture.texture import Texture
from sl_nerfstudio.meshing.vertex_colour import point_colours
from sl_nerfstudio.meshing.vertex_properties import GREY
from sl_nerfstudio.scan.types import Scan

_AT_A_TIME = 2**22  # texels: a gigabyte


@dataclass(frozen=True)
class Textured:
    """A texture and how it came about; lengths in the mesh's unit."""

    texture: Texture
    texel: float  # side of a pixel on the surface, on average
    seen: float  # share of the surface's pixels that some picture shows; the others are grey
    pictures: int
    layout_seconds: float


def surface_texture(mesh: Mesh, size: int, whole: Mesh, scan: Scan, poses: DevicePoses) -> Textured:
    """A texture of size x size pixels for `mesh`, coloured as vertices are: see `point_colours`.

    `whole` is the mesh before it was decimated, or the same one: each pixel has the colour of the closest point there.
    Pixels up to two beside a chart have the colour of its edge, all others that of the nearest pixel, so that neither
    filters nor smaller copies of the image show what is between the charts.
    """
    start = time.perf_counter()
    charts = square_charts(mesh, size)
    seconds = time.perf_counter() - start
    uv = charts.uv[charts.corners].astype(np.float64)
    triangle, weights = draw_triangles(uv, size)
    texels = np.flatnonzero(triangle >= 0)
    image = np.full((size * size, 3), GREY, dtype=np.uint8)
    surface, occluder, seen, pictures = _Surface(mesh, whole), Occluder(whole), 0, 0
    for first in range(0, len(texels), _AT_A_TIME):
        some = texels[first : first + _AT_A_TIME]
        points, normals = surface.at(triangle.reshape(-1)[some], weights.reshape(-1, 3)[some])
        colours = point_colours(points, normals, occluder, scan, poses, "colours of the texture")
        image[some] = colours.rgb
        seen, pictures = seen + int(colours.seen.sum()), colours.pictures
    filled = _filled(image.reshape(size, size, 3), triangle >= 0)
    texel = (float(mesh.face_areas().sum()) / max(_area(uv), 1e-300)) ** 0.5 / size
    return Textured(Texture(charts, filled), texel, seen / max(len(texels), 1), pictures, seconds)


class _Surface:
    """Points of a mesh, on the surface that it had before it was decimated."""

    def __init__(self, mesh: Mesh, whole: Mesh) -> None:
        self._mesh, self._whole, self._normals = mesh, whole, whole.vertex_normals()
        self._closest = None if mesh is whole else ClosestSurface(whole)

    def at(
        self, triangle: Int[ndarray, "n"], weights: Float[ndarray, "n 3"]
    ) -> tuple[Float64[ndarray, "n 3"], Float64[ndarray, "n 3"]]:
        """Places and unit normals at weighted corners; weights beside the triangle are moved to its edge."""
        inside = np.maximum(weights, 0).astype(np.float64)
        inside /= inside.sum(1, keepdims=True)
        points = _mean(self._mesh.vertices, self._mesh.faces[triangle], inside)
        if self._closest is not None:
            found = self._closest.closest(points)
            triangle, inside = found.triangle, found.weights
            points = _mean(self._whole.vertices, self._whole.faces[triangle], inside)
        normals = _mean(self._normals, self._whole.faces[triangle], inside)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return points, normals / np.where(length > 0, length, 1.0)


def _mean(
    values: Float64[ndarray, "v 3"], corners: Int[ndarray, "n 3"], weights: Float64[ndarray, "n 3"]
) -> Float64[ndarray, "n 3"]:
    return np.einsum("nk,nki->ni", weights, values[corners])


def _filled(image: UInt8[ndarray, "n n 3"], known: Bool[ndarray, "n n"]) -> UInt8[ndarray, "n n 3"]:
    """The image with the nearest known pixel's value in every other one."""
    import cv2

    kind = cv2.DIST_LABEL_PIXEL  # each known pixel has a label of its own
    _, label = cv2.distanceTransformWithLabels((~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=kind)
    of_label = np.zeros((int(label.max()) + 1, 3), np.uint8)
    of_label[label[known]] = image[known]
    return of_label[label]


def _area(corners: Float64[ndarray, "f 3 2"]) -> float:
    """Of triangles in the plane."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return float(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()) / 2
