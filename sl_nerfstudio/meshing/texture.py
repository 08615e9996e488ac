"""Colours of a surface, of its vertices or as a texture, from captures that were also taken without the pattern."""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
import xatlas
from jaxtyping import Bool, Float, Float64, Int, Int64, UInt8
from numpy import ndarray
from scipy.ndimage import map_coordinates

from sl_nerfstudio.console import track
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.geometry.numerics import evenly_spaced
from sl_nerfstudio.geometry.triangulation import world_pixels
from sl_nerfstudio.meshing.finish import ClosestSurface
from sl_nerfstudio.meshing.mesh import GREY, Charts, Mesh, Texture, as_linear, as_srgb
from sl_nerfstudio.meshing.visibility import Occluder
from sl_nerfstudio.parallel import compiled, results, threads
from sl_nerfstudio.scan.types import Frame, Scan

_LEAST_COSINE = 0.2
"""Between normal and line of sight: flatter views (beyond 78 degrees) mix in what is behind the edge of the object."""


@dataclass(frozen=True)
class Colours:
    """Colours of points of a surface."""

    rgb: UInt8[ndarray, "n 3"]  # sRGB; GREY where no picture shows the point
    seen: Bool[ndarray, "n"]  # by at least one picture


class Pictures:
    """The captures without the pattern at their poses, with their exposures evened out.

    A picture sees a point of a mesh that faces its camera, is inside the image, and that the mesh hides not; a picture
    that is the capture itself (of Gray code, in full light) only what the projector lights. What several pictures see
    tells how much brighter each is than the others, in red, green and blue: its `gains`, of linear light, by which its
    colours are divided. Their geometric mean is 1.
    """

    gains: Float64[ndarray, "pictures 3"]

    def __init__(self, mesh: Mesh, scan: Scan, poses: DevicePoses) -> None:
        """Raises ValueError for a scan without pictures."""
        self._occluder, self.task = Occluder(mesh), "colours of the surface"
        self._frames = [(frame, poses.T_world_camera[k]) for k, frame in enumerate(scan.frames) if frame.color_path]
        if not self._frames:
            raise ValueError(f"{scan.root} has no picture without the pattern")
        self.gains = np.ones((len(self._frames), 3))
        some = evenly_spaced(len(mesh.vertices), min(len(mesh.vertices), _COMPARED))
        if len(self._frames) > 1:
            self.gains = self._compared(mesh.vertices[some], mesh.vertex_normals()[some])

    def __len__(self) -> int:
        """How many there are."""
        return len(self._frames)

    def exposures(self) -> dict[str, list[float]]:
        """The gains by the names of the frames."""
        return {frame.name: gain.tolist() for (frame, _), gain in zip(self._frames, self.gains, strict=True)}

    def colours(self, points: Float64[ndarray, "n 3"], normals: Float64[ndarray, "n 3"]) -> Colours:
        """The mean of linear light over all pictures that see a point, weighted by the squared cosine of the angle.

        This is the angle between the normal and the line of sight. Saturated pixels count where nothing else shows the
        point. As many pictures are in memory at a time as there are threads.
        """
        total, weight = np.zeros((len(points), 3)), np.zeros(len(points))
        for gain, (index, square, light) in zip(self.gains, self._looks(points, normals), strict=True):
            square = np.where(light.max(1) < _SATURATED, square, _HARDLY * square)
            total[index] += square[:, None] * light / gain
            weight[index] += square
        seen = weight > 0
        rgb = as_srgb(total / np.where(seen, weight, 1.0)[:, None])
        return Colours(np.where(seen[:, None], np.round(255 * rgb), GREY).astype(np.uint8), seen)

    def _compared(self, points: Float64[ndarray, "n 3"], normals: Float64[ndarray, "n 3"]) -> Float64[ndarray, "k 3"]:
        light = np.full((len(self._frames), len(points), 3), np.nan)
        square = np.zeros((len(self._frames), len(points)))
        for k, (index, weights, seen) in enumerate(self._looks(points, normals)):
            usable = (seen > _DARK).all(1) & (seen < _SATURATED).all(1)
            light[k, index[usable]], square[k, index[usable]] = np.log(seen[usable]), weights[usable]
        return np.exp(np.stack([relative_levels(light[..., c], square) for c in range(3)], 1))

    def _looks(
        self, points: Float64[ndarray, "n 3"], normals: Float64[ndarray, "n 3"]
    ) -> Iterator[tuple[Int64[ndarray, "m"], Float64[ndarray, "m"], Float64[ndarray, "m 3"]]]:
        """What each picture sees: see `_look`."""
        for first in track(range(0, len(self._frames), threads()), self.task):
            some = self._frames[first : first + threads()]
            yield from results([partial(_look, points, normals, self._occluder, *one) for one in some])


_COMPARED = 20_000  # vertices that tell the exposures
_DARK, _SATURATED = 0.01, 0.97  # of linear light at full scale: beyond, a pixel does not tell how bright it was
_HARDLY = 1e-3
_ROUNDS, _DOUBTFUL = 20, 0.1  # of the robust fit; a difference of the logarithms, as shadows and reflections make


def relative_levels(
    values: Float64[ndarray, "pictures points"], weights: Float64[ndarray, "pictures points"]
) -> Float64[ndarray, "pictures"]:
    """Levels x such that x + y explains the values best, with a y for each point; their mean is 0.

    Values with weight 0 are not looked at. Those that differ much from what the others say count less (Cauchy).
    Pictures that share no point with the others, by any way, are compared among themselves alone.
    """
    several = (weights > 0).sum(0) > 1
    values, weights = np.where(weights > 0, values, 0.0)[:, several], weights[:, several]
    level, robust = np.zeros(len(values)), weights
    for _ in range(_ROUNDS):
        total = np.maximum(robust.sum(0), 1e-300)
        of_points = (robust * (values - level[:, None])).sum(0) / total
        off = values - level[:, None] - of_points
        robust = weights / (1 + (off / _DOUBTFUL) ** 2)
        total = np.maximum(robust.sum(0), 1e-300)
        H = np.diag(robust.sum(1)) - (robust / total) @ robust.T  # the points' unknowns are eliminated
        g = (robust * (values - (robust * values).sum(0) / total)).sum(1)
        level = np.linalg.lstsq(H, g, rcond=1e-9)[0]
    return level - level.mean() if len(level) else level


def has_pictures(scan: Scan) -> bool:
    """Whether some frame was also captured without the pattern."""
    return any(frame.color_path is not None for frame in scan.frames)


def _look(
    points: Float64[ndarray, "n 3"],
    normals: Float64[ndarray, "n 3"],
    occluder: Occluder,
    frame: Frame,
    T_world_camera: Float64[ndarray, "4 4"],
) -> tuple[Int64[ndarray, "m"], Float64[ndarray, "m"], Float64[ndarray, "m 3"]]:
    """Points that a picture sees, squared cosines between their normals and lines of sight, and their linear light."""
    eye = T_world_camera[:3, 3]
    way = eye - points
    cosine = np.einsum("vi,vi->v", way, normals) / np.linalg.norm(way, axis=1)
    index = np.flatnonzero(cosine > _LEAST_COSINE)
    uv, inside = world_pixels(frame.camera, T_world_camera, points[index])
    index, uv = index[inside], uv[inside]
    free = ~occluder.hidden(points, normals, index, eye)
    index, uv = index[free], uv[free]
    if frame.color_path == frame.image_path:
        column, row = np.floor(uv).astype(np.int64).T
        lit = frame.read_mask()[row, column]
        index, uv = index[lit], uv[lit]
    return index, cosine[index] ** 2, as_linear(_look_up(frame, uv))


def _look_up(frame: Frame, uv: Float64[ndarray, "n 2"]) -> Float64[ndarray, "n 3"]:
    """Bilinear values of the frame's picture in [0, 1]; grey pictures in all three channels."""
    image = frame.read_color()
    assert image is not None  # frames without a picture are not asked
    values = image.reshape(*image.shape[:2], -1) / np.iinfo(image.dtype).max
    place = (uv - 0.5).T[::-1]  # the centre of the first pixel is (0.5, 0.5)
    channels = [map_coordinates(values[..., c], place, order=1, mode="nearest") for c in range(values.shape[2])]
    return np.stack(channels * (3 // len(channels)), 1)


# A mesh laid out flat: pieces of it (charts) side by side in a square.

MANY_CHARTS = 500
"""Least number of charts: 50,000 triangles of a scan take 4 s then, and 28 s if charts may be large."""

_PIECE = 30000  # triangles that xatlas gets at once: 526,000 take 32 s then, on one thread (whole: 54 s)
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


# Triangles drawn into a square image: which of them is at each pixel, and where in it.

_GUTTER_PX = 2.0  # how far beside a triangle pixels get its colour: texture filters read beyond the edge


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


_AT_A_TIME = 2**22  # texels: a gigabyte


@dataclass(frozen=True)
class Textured:
    """A texture and how it came about; lengths in the mesh's unit."""

    texture: Texture
    texel: float  # side of a pixel on the surface, on average
    seen: float  # share of the surface's pixels that some picture shows; the others are grey
    layout_seconds: float


def surface_texture(mesh: Mesh, size: int, whole: Mesh, pictures: Pictures) -> Textured:
    """A texture of size x size pixels for `mesh`, coloured as vertices are: see `Pictures.colours`.

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
    closest, seen, pictures.task = None if mesh is whole else ClosestSurface(whole), 0, "colours of the texture"
    for first in range(0, len(texels), _AT_A_TIME):
        some = texels[first : first + _AT_A_TIME]
        at = triangle.reshape(-1)[some], weights.reshape(-1, 3)[some]
        points, normals = _on_whole(mesh, whole, closest, *at)
        colours = pictures.colours(points, normals)
        image[some] = colours.rgb
        seen += int(colours.seen.sum())
    filled = _filled(image.reshape(size, size, 3), triangle >= 0)
    (ax, ay), (bx, by) = (uv[:, 1] - uv[:, 0]).T, (uv[:, 2] - uv[:, 0]).T
    flat = float(np.abs(ax * by - ay * bx).sum()) / 2  # area of the charts
    texel = (float(mesh.face_areas().sum()) / max(flat, 1e-300)) ** 0.5 / size
    return Textured(Texture(charts, filled), texel, seen / max(len(texels), 1), seconds)


def _on_whole(
    mesh: Mesh, whole: Mesh, closest: ClosestSurface | None, triangle: Int[ndarray, "n"], weights: Float[ndarray, "n 3"]
) -> tuple[Float64[ndarray, "n 3"], Float64[ndarray, "n 3"]]:
    """Places and unit normals on the whole mesh at weighted corners; weights beside a triangle are moved to its edge.

    `closest` is of the whole mesh, None if it is the same.
    """
    inside = np.maximum(weights, 0).astype(np.float64)
    inside /= inside.sum(1, keepdims=True)
    points = _mean(mesh.vertices, mesh.faces[triangle], inside)
    if closest is not None:
        found = closest.closest(points)
        triangle, inside = found.triangle, found.weights
        points = _mean(whole.vertices, whole.faces[triangle], inside)
    normals = _mean(whole.vertex_normals(), whole.faces[triangle], inside)
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
