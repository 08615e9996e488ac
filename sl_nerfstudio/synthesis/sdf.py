"""Building blocks of free-form objects: (approximate) signed distances, positive outside, and how to join them.

After Inigo Quilez' distance functions. The distance of an ellipsoid is correct to first order, so its values are
distances only near the surface; that is enough to find the zero level.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial.transform import Rotation
from skimage.measure import marching_cubes

from sl_nerfstudio.console import track

# A scene: a surface in millimetres, with what rendering and paths need to know about it.


@dataclass(frozen=True)
class Scene:
    """A triangle mesh; z is up, and the object is near the origin. All lengths in millimetres.

    `vertex_normals` (unit) make the shading smooth; with None it is flat. `elevation_deg` is the range of elevations
    from which cameras look at it.
    """

    name: str
    vertices: Float[ndarray, "v 3"]
    faces: Int[ndarray, "f 3"]
    vertex_normals: Float[ndarray, "v 3"] | None = None
    elevation_deg: tuple[float, float] = (25.0, 65.0)

    @cached_property
    def centre(self) -> Float[ndarray, "3"]:
        """Middle of the bounding box: what the devices look at."""
        return (self.vertices.min(0) + self.vertices.max(0)) / 2

    @cached_property
    def size(self) -> float:
        """Longest side of the bounding box."""
        return float(np.ptp(self.vertices, axis=0).max())

    @cached_property
    def face_normals(self) -> Float[ndarray, "f 3"]:
        """Unit normals of the faces, outwards for a closed mesh."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        normals = np.cross(b - a, c - a)
        return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)


Number = float | int
Triple = tuple[Number, Number, Number]
Field = Callable[[Float[ndarray, "n 3"]], Float[ndarray, "n"]]
_NEWTON_STEPS = 2
_COARSE = 4  # cells, between the points at which a field is sampled first
_BLOCK = 50_000  # points evaluated together


def ellipsoid(centre: Triple, radii: Triple, turn_deg: Triple = (0.0, 0.0, 0.0)) -> Field:
    """An ellipsoid, rotated about its centre by angles about x, y and z, in that order."""
    c, r = np.asarray(centre, dtype=np.float64), np.asarray(radii, dtype=np.float64)
    R = Rotation.from_euler("xyz", turn_deg, degrees=True).as_matrix()

    def field(p: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        q = (p - c) @ R / r
        k0 = _length(q)
        k1 = _length(q / r)
        return np.where(k1 > 1e-9, k0 * (k0 - 1) / np.maximum(k1, 1e-9), -r.min())  # the centre has no gradient

    return field


def capsule(a: Triple, b: Triple, radius_a: Number, radius_b: Number) -> Field:
    """A rod from `a` to `b` with round ends, whose radius changes linearly."""
    start, end = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    axis = end - start

    def field(p: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        t = np.clip((p - start) @ axis / (axis @ axis), 0, 1)
        return _length(p - start - t[:, None] * axis) - (radius_a + t * (radius_b - radius_a))

    return field


def cylinder(a: Triple, b: Triple, radius: Number, rounding: Number = 0.0) -> Field:
    """A cylinder from `a` to `b` with flat ends, its edges rounded."""
    start, end = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    axis = (end - start) / np.linalg.norm(end - start)
    half = np.linalg.norm(end - start) / 2

    def field(p: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        q = p - (start + end) / 2
        along = q @ axis
        beside = _length(q - along[:, None] * axis) - radius + rounding
        beyond = np.abs(along) - half + rounding
        outside = np.sqrt(np.maximum(beside, 0) ** 2 + np.maximum(beyond, 0) ** 2)
        return outside + np.minimum(np.maximum(beside, beyond), 0) - rounding

    return field


def block(low: Triple, high: Triple) -> Field:
    """A box with sharp edges."""
    middle, half = (np.add(low, high)) / 2, np.subtract(high, low) / 2

    def field(p: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        q = np.abs(p - middle) - half
        return np.sqrt((np.maximum(q, 0) ** 2).sum(-1)) + np.minimum(q.max(-1), 0)

    return field


def ridges(solid: Field, height: float, wave: Field) -> Field:
    """The solid with its surface raised and lowered by up to `height`; `wave` gives the phase in radians."""
    return lambda p: solid(p) - height * np.sin(wave(p))


def half_space(normal: Triple, offset: float) -> Field:
    """Everything on the side of the plane `normal . p = offset` that the (unit) normal points away from."""
    n = np.asarray(normal, dtype=np.float64)
    return lambda p: p @ n - offset


def union(blend: float, *fields: Field) -> Field:
    """Everything in any of the fields; where two meet, a fillet about `blend` wide (0: a sharp edge)."""

    def field(p: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        out = fields[0](p)
        for other in fields[1:]:
            out = _smooth_min(out, other(p), blend)
        return out

    return field


def carve(blend: float, solid: Field, *tools: Field) -> Field:
    """The solid without what is inside the tools; edges rounded by about `blend`."""

    def field(p: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        out = solid(p)
        for tool in tools:
            out = -_smooth_min(-out, tool(p), blend)
        return out

    return field


def mirrored(field: Field) -> Field:
    """The field of the half where x is positive, on both sides."""
    return lambda p: field(np.column_stack([np.abs(p[:, 0]), p[:, 1:]]))


def mesh_of(
    name: str,
    field: Field,
    lower: Triple,
    upper: Triple,
    cell: float,
    elevation_deg: tuple[float, float] = (25.0, 65.0),
) -> Scene:
    """The zero level inside a box as a closed mesh with cells of `cell`, its vertices moved onto the level.

    Coarse to fine: only cells near the level are looked at closely. Raises ValueError if the surface leaves the box.
    """
    # planes of the object must not be planes of the grid: exact zeros make marching cubes produce empty triangles
    low = np.asarray(lower, dtype=np.float64) - np.array([0.31, 0.37, 0.41]) * cell
    count = np.ceil((np.asarray(upper) - low) / (_COARSE * cell)).astype(int) * _COARSE
    values = _sample_near_level(field, low, count, cell)
    rim = np.concatenate([values[[0, -1]].ravel(), values[:, [0, -1]].ravel(), values[:, :, [0, -1]].ravel()])
    if rim.min() <= 0:
        raise ValueError(f"the surface of {name} leaves its box")
    vertices, faces, _, _ = marching_cubes(values, 0.0, spacing=(cell,) * 3, gradient_direction="descent")
    vertices = vertices.astype(np.float64) + low
    vertices = _onto_level(field, vertices, _gradient(field, vertices, 0.05 * cell), cell)
    normals = _gradient(field, vertices, 0.05 * cell)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return Scene(name, vertices, faces.astype(np.int64), normals, elevation_deg)


def _length(v: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
    return np.sqrt(np.einsum("ij,ij->i", v, v))


def _smooth_min(a: Float[ndarray, "n"], b: Float[ndarray, "n"], blend: float) -> Float[ndarray, "n"]:
    if blend == 0:
        return np.minimum(a, b)
    h = np.maximum(blend - np.abs(a - b), 0) / blend
    return np.minimum(a, b) - h * h * blend / 4


def _sample_near_level(field: Field, low: Float[ndarray, "3"], count: ndarray, cell: float) -> Float[ndarray, "x y z"]:
    """Values on a grid of count + 1 points; away from the level, only the sign of the nearest coarse point."""
    step = _COARSE
    coarse = _on_grid(field, low, count // step + 1, step * cell)
    fine = np.sign(coarse)
    for axis in range(3):
        fine = np.repeat(fine, step, axis)
    fine = fine[tuple(slice(0, n + 1) for n in count)]
    # a coarse point this close to the level may have it in one of its cells (with a margin: values are inexact)
    near = np.abs(coarse) < 1.2 * np.sqrt(3) * step * cell
    index = np.argwhere(near)
    offset = np.stack(np.meshgrid(*[np.arange(-step + 1, step)] * 3, indexing="ij"), -1).reshape(-1, 3)
    wanted = np.zeros(count + 1, dtype=bool)
    for shift in offset:
        place = index * step + shift
        place = place[((place >= 0) & (place <= count)).all(1)]
        wanted[tuple(place.T)] = True
    places = np.argwhere(wanted)
    for start in track(range(0, len(places), _BLOCK), "shaping"):
        block = places[start : start + _BLOCK]
        fine[tuple(block.T)] = field(low + cell * block)
    return fine


def _on_grid(field: Field, low: Float[ndarray, "3"], count: ndarray, cell: float) -> Float[ndarray, "x y z"]:
    places = np.stack(np.meshgrid(*[np.arange(n) for n in count], indexing="ij"), -1).reshape(-1, 3)
    return field(low + cell * places).reshape(*count)


def _onto_level(
    field: Field, p: Float[ndarray, "n 3"], gradient: Float[ndarray, "n 3"], cell: float
) -> Float[ndarray, "n 3"]:
    """Newton's method along the gradient; a vertex that would move by half a cell stays (sharp edges)."""
    along = gradient / np.maximum((gradient**2).sum(-1, keepdims=True), 1e-6)
    moved = np.zeros((len(p), 1))
    for _ in range(_NEWTON_STEPS):
        moved -= field(p + moved * along)[:, None]
    far = np.linalg.norm(moved * along, axis=1) > 0.5 * cell
    return np.where(far[:, None], p, p + moved * along)


def _gradient(field: Field, p: Float[ndarray, "n 3"], h: float) -> Float[ndarray, "n 3"]:
    """Gradient from the values at the corners of a tetrahedron."""
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=np.float64)
    return sum((field(p + h * e)[:, None] * e for e in corners), np.zeros_like(p)) / (4 * h)
