"""Visibility: frames that see, confirm or contradict each vertex of a mesh, and the part that they observed."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from numpy import ndarray
from scipy.ndimage import binary_dilation

from sl_nerfstudio.console import track
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import MODELS, Device, Intrinsics, ray_of, view_of
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.geometry.numerics import component_labels
from sl_nerfstudio.meshing.mesh import Mesh, ray_scene
from sl_nerfstudio.parallel import compiled, compiled_range
from sl_nerfstudio.scan.types import Frame, Scan

# One point of a surface as one frame sees it, and the derivatives of its residual, in compiled loops.
#
# Formulas and conventions are those of `surface_derivatives`, which wraps these loops for arrays.

# A frame's devices as one row: world to camera and camera to projector (rows of 3 x 4 matrices), the projector's centre
# in camera axes, the parameters and the codes of both models.
CAMERA_POSE, PROJECTOR_POSE, CENTRE, CAMERA, PROJECTOR, CODES, DEVICES = 0, 12, 24, 27, 35, 43, 45
SURFACE_VIEW = np.dtype([
    ("p_camera", "f8", 3),
    ("by_point", "f8", (2, 3)),  # of the predicted coordinate by the point in the camera's axes
    ("uv_camera", "f8", 2),
    ("uv_projector", "f8", 2),  # predicted
    ("slope", "f8", 2),  # of the residual, projector pixels per unit of length along the normal
    ("by_pixel", "f8", (2, 2)),  # of the predicted coordinate by the camera pixel, along the surface
    ("pixels_per_area", "f8"),  # camera pixels on a unit of the surface's area
    ("ray_angle", "f8"),  # between camera ray and projector ray, radian
])  # fmt: skip
"""What is known of one point, as one row; and where its parts begin, for compiled loops."""
P_CAMERA, BY_POINT, UV_CAMERA, UV_PROJECTOR, SLOPE, BY_PIXEL, AREA, ANGLE, VIEW = 0, 3, 9, 11, 13, 15, 19, 20, 21


@compiled
def moved(T, first, x, y, z):
    """A point moved by the 3 x 4 matrix whose numbers begin at `first`."""
    a = T[first] * x + T[first + 1] * y + T[first + 2] * z + T[first + 3]
    b = T[first + 4] * x + T[first + 5] * y + T[first + 6] * z + T[first + 7]
    c = T[first + 8] * x + T[first + 9] * y + T[first + 10] * z + T[first + 11]
    return a, b, c


@compiled
def _turned(T, first, x, y, z):
    a, b, c = moved(T, first, x, y, z)
    return a - T[first + 3], b - T[first + 7], c - T[first + 11]


@compiled
def view_point(devices, point, normal, view):
    """Fill `view` (VIEW,) for a point and its unit normal in the world, seen by `devices` (DEVICES,)."""
    x, y, z = moved(devices, CAMERA_POSE, point[0], point[1], point[2])
    a, b, c = _turned(devices, CAMERA_POSE, normal[0], normal[1], normal[2])
    view[P_CAMERA], view[P_CAMERA + 1], view[P_CAMERA + 2] = x, y, z
    u, v, _, k0, k1, k2, k3, k4, k5 = view_of(devices[CODES], x, y, z, devices[CAMERA:PROJECTOR])
    view[UV_CAMERA], view[UV_CAMERA + 1] = u, v
    X, Y, Z = moved(devices, PROJECTOR_POSE, x, y, z)
    u, v, _, j0, j1, j2, j3, j4, j5 = view_of(devices[CODES + 1], X, Y, Z, devices[PROJECTOR:CODES])
    view[UV_PROJECTOR], view[UV_PROJECTOR + 1] = u, v
    R = devices[PROJECTOR_POSE:CENTRE]
    for k in range(3):
        view[BY_POINT + k] = j0 * R[k] + j1 * R[4 + k] + j2 * R[8 + k]
        view[BY_POINT + 3 + k] = j3 * R[k] + j4 * R[4 + k] + j5 * R[8 + k]
    p0, p1, p2, q0, q1, q2 = view[BY_POINT:UV_CAMERA]
    facing = x * a + y * b + z * c
    view[SLOPE] = (p0 * x + p1 * y + p2 * z) / facing
    view[SLOPE + 1] = (q0 * x + q1 * y + q2 * z) / facing
    # Columns of the inverse of the rows (k0 k1 k2), (k3 k4 k5), (a b c): motions along the surface by one pixel.
    e0, e1, e2 = k4 * c - k5 * b, k5 * a - k3 * c, k3 * b - k4 * a
    f0, f1, f2 = b * k2 - c * k1, c * k0 - a * k2, a * k1 - b * k0
    area = k0 * e0 + k1 * e1 + k2 * e2
    view[BY_PIXEL], view[BY_PIXEL + 1] = (p0 * e0 + p1 * e1 + p2 * e2) / area, (p0 * f0 + p1 * f1 + p2 * f2) / area
    view[BY_PIXEL + 2], view[BY_PIXEL + 3] = (q0 * e0 + q1 * e1 + q2 * e2) / area, (q0 * f0 + q1 * f1 + q2 * f2) / area
    view[AREA] = abs(area)
    bx, by, bz = x - devices[CENTRE], y - devices[CENTRE + 1], z - devices[CENTRE + 2]
    lengths = ((x * x + y * y + z * z) * (bx * bx + by * by + bz * bz)) ** 0.5
    view[ANGLE] = np.arccos(min(max((x * bx + y * by + z * bz) / lengths, -1.0), 1.0))


@compiled
def derive_residual(devices, point, normal, view, by):
    """Fill `by` (2, 18): derivatives of the residual by delta and rho of the frame, then by the intrinsics."""
    x, y, z = view[P_CAMERA:BY_POINT]
    # A frame that moves carries along what it measured: only the motion across the surface changes the residual.
    turn0 = point[1] * normal[2] - point[2] * normal[1]
    turn1 = point[2] * normal[0] - point[0] * normal[2]
    turn2 = point[0] * normal[1] - point[1] * normal[0]
    camera, projector = devices[CAMERA:PROJECTOR], devices[PROJECTOR:CODES]
    du, dv = view[UV_CAMERA] - camera[2], view[UV_CAMERA + 1] - camera[3]
    for i in range(2):
        slope = view[SLOPE + i]
        by[i, 0], by[i, 1], by[i, 2] = -slope * normal[0], -slope * normal[1], -slope * normal[2]
        by[i, 3], by[i, 4], by[i, 5] = -slope * turn0, -slope * turn1, -slope * turn2
        b0, b1, b2 = view[BY_POINT + 3 * i], view[BY_POINT + 3 * i + 1], view[BY_POINT + 3 * i + 2]
        by[i, 6], by[i, 7], by[i, 8] = -b0, -b1, -b2
        by[i, 9], by[i, 10], by[i, 11] = b1 * z - b2 * y, b2 * x - b0 * z, b0 * y - b1 * x
        across, down = view[BY_PIXEL + 2 * i], view[BY_PIXEL + 2 * i + 1]
        by[i, 12] = -across * du - down * dv
        by[i, 13], by[i, 14] = -across * camera[0], -down * camera[0]
        by[i, 15] = view[UV_PROJECTOR + i] - projector[2 + i]
        by[i, 16], by[i, 17] = projector[0] * (i == 0), projector[0] * (i == 1)


@compiled
def write_rows(confirmed, devices, points, normals, out):
    """Fill `out` (v, 12 frames + 6), which must be zero: by delta of some frames, their rho, and the intrinsics.

    `confirmed` (v, frames) says which of those frames confirm which vertices. A vertex moves by minus the weighted mean
    of its frames' pulls, each the product of a residual's slope and derivatives.
    """
    view, by, frames = np.empty(VIEW), np.empty((2, 18)), len(devices)
    for v in range(len(points)):
        total = 0.0
        for k in range(frames):
            if not confirmed[v, k]:
                continue
            view_point(devices[k], points[v], normals[v], view)
            derive_residual(devices[k], points[v], normals[v], view, by)
            s, t, w = view[SLOPE], view[SLOPE + 1], view[AREA]
            total += w * (s * s + t * t)
            for i in range(6):
                out[v, 6 * k + i] -= w * (s * by[0, i] + t * by[1, i])
                out[v, 6 * (frames + k) + i] -= w * (s * by[0, 6 + i] + t * by[1, 6 + i])
                out[v, 12 * frames + i] -= w * (s * by[0, 12 + i] + t * by[1, 12 + i])
        for i in range(out.shape[1]):
            out[v, i] /= total


# How far the coordinate that a vertex predicts is from those that were decoded around its pixel.
#
# Where four decoded neighbours vary no more than the tangent plane of the surface predicts, their bilinear value is
# compared. Otherwise (an edge, or undecoded neighbours) the best of nine pixels is used, each compared with the
# prediction on the tangent plane. The surface may bend away from that plane by half of the plane's own change, which is
# the difference between the two bounds.

# A device as one row: world to device (a 3 x 4 matrix), where it is, parameters, code, width and height.
WORLD, EYE, PARAMETERS, CODE, WIDTH, HEIGHT = 0, 12, 15, 23, 24, 25


@compiled
def _within(value, limit):
    """The value, or the limit with its sign if it is beyond; NaN stays."""
    return limit if value > limit else -limit if value < -limit else value


@compiled
def _on_tangent_plane(camera, projector, point, normal, u, v):
    """The coordinate that a plane through a vertex predicts for another camera pixel."""
    a, b, c = ray_of(camera[CODE], u, v, camera[PARAMETERS:CODE])
    x = camera[0] * a + camera[4] * b + camera[8] * c
    y = camera[1] * a + camera[5] * b + camera[9] * c
    z = camera[2] * a + camera[6] * b + camera[10] * c
    ox, oy, oz = camera[EYE], camera[EYE + 1], camera[EYE + 2]
    towards = x * normal[0] + y * normal[1] + z * normal[2]
    away = (point[0] - ox) * normal[0] + (point[1] - oy) * normal[1] + (point[2] - oz) * normal[2]
    distance = away / (towards if towards < 0 else -1e-12)
    X, Y, Z = moved(projector, WORLD, ox + distance * x, oy + distance * y, oz + distance * z)
    found = view_of(projector[CODE], X, Y, Z, projector[PARAMETERS:CODE])
    return found[0], found[1]


@compiled
def _at(coords, row, column, k):
    """A component of the decoded coordinate, beyond the image that of its border."""
    return coords[min(max(row, 0), coords.shape[0] - 1), min(max(column, 0), coords.shape[1] - 1), k]


@compiled
def _bilinear(coords, uv, predicted, most_spread):
    """Distance of the decoded coordinate from the predicted one; NaN where neighbours vary too much or are missing."""
    column, row = math.floor(uv[0] - 0.5), math.floor(uv[1] - 0.5)
    x, y = uv[0] - 0.5 - column, uv[1] - 0.5 - row
    length, spread = 0.0, 0.0
    for k in range(2):
        a = _at(coords, row, column, k) - predicted[k]
        b = _at(coords, row, column + 1, k) - predicted[k]
        c = _at(coords, row + 1, column, k) - predicted[k]
        d = _at(coords, row + 1, column + 1, k) - predicted[k]
        value = (1 - y) * ((1 - x) * a + x * b) + y * ((1 - x) * c + x * d)
        length += value * value
        span = max(max(a, b), max(c, d)) - min(min(a, b), min(c, d))
        spread += span * span if value == value else np.nan
    return math.sqrt(length) if math.sqrt(spread) <= most_spread else np.nan


@compiled
def _best_of_nine(coords, uv, predicted, J, slope):
    """Bounds of the distance for the pixel, of nine, that agrees best with the tangent plane; NaN if none is known."""
    column, row = math.floor(uv[0]), math.floor(uv[1])
    least, most = np.nan, np.nan
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            x, y = column + dx + 0.5 - uv[0], row + dy + 0.5 - uv[1]
            a = _at(coords, row + dy, column + dx, 0) - predicted[0] - (J[0] * x + J[1] * y)
            b = _at(coords, row + dy, column + dx, 1) - predicted[1] - (J[2] * x + J[3] * y)
            distance = math.hypot(a, b)
            closest = max(distance - 0.5 * slope * math.hypot(x, y), 0.0)
            if distance == distance:
                most = distance if not most <= distance else most
                least = closest if not least <= closest else least
    return least, most


@compiled_range
def compare_decoded(first, last, points, normals, which, uv, coords, mask, grown, devices, most_px, offsets, outside):
    """Fill `offsets` (n, 2), bounds of the distance that begin as NaN, and `outside` (n, 2): of `grown`, and of `mask`.

    `uv` (n, 2, 2) are the pixels in camera and pattern of the vertices `which` (n,). `devices` (2, 26) are camera and
    projector. Changes of the coordinate by a camera pixel above `most_px` count as `most_px`.
    """
    for i in range(first, last):
        point, normal, predicted = points[which[i]], normals[which[i]], uv[i, 1]
        u, v = uv[i, 0]
        outside[i, 0] = not grown[int(v), int(u)]
        outside[i, 1] = not mask[int(v), int(u)]
        if outside[i, 1]:
            continue
        right = _on_tangent_plane(devices[0], devices[1], point, normal, u + 1, v)
        below = _on_tangent_plane(devices[0], devices[1], point, normal, u, v + 1)
        J = (
            _within(right[0] - predicted[0], most_px),
            _within(below[0] - predicted[0], most_px),
            _within(right[1] - predicted[1], most_px),
            _within(below[1] - predicted[1], most_px),
        )
        slope = math.sqrt(J[0] * J[0] + J[1] * J[1] + J[2] * J[2] + J[3] * J[3])
        offset = _bilinear(coords, uv[i, 0], predicted, 2 * slope + 1)
        if offset == offset:
            offsets[i, 0] = offsets[i, 1] = offset
        else:
            offsets[i, 0], offsets[i, 1] = _best_of_nine(coords, uv[i, 0], predicted, J, slope)


# The vertices of a mesh that a camera sees and a projector lights.


class Occluder:
    """Finds out whether a mesh hides its own vertices from a device."""

    def __init__(self, mesh: Mesh) -> None:
        """`mesh` may be open; both of its sides hide what is behind them."""
        self._centre = mesh.vertices.mean(0)
        self._scale = 1 / max(float(np.ptp(mesh.vertices, axis=0).max()), 1e-300)
        self._start = 2 * mesh.edge_length()
        self._scene = ray_scene((mesh.vertices - self._centre) * self._scale, mesh.faces)

    def hidden(
        self,
        points: Float[ndarray, "v 3"],
        normals: Float[ndarray, "v 3"],
        chosen: Int64[ndarray, "n"],
        eye: Float[ndarray, "3"],
    ) -> Bool[ndarray, "n"]:
        """Whether the mesh is between `eye` and some points on the mesh, all of which face `eye`.

        Rays start two edge lengths away from the surface, along the normal and towards the eye, so that they do not hit
        the triangles they start from.
        """
        from sl_nerfstudio.late_imports import open3d as o3d

        rays = np.empty((len(chosen), 6), np.float32)
        _write_rays(len(chosen), points, normals, chosen, eye, self._start, self._centre, self._scale, rays)
        return self._scene.test_occlusions(o3d.core.Tensor(rays), tnear=0.0, tfar=1.0).numpy()


def lit_vertices(
    vertices: Float[ndarray, "v 3"],
    normals: Float[ndarray, "v 3"],
    chosen: Int64[ndarray, "c"],
    occluder: Occluder,
    camera: Device,
    projector: Device,
    T_world_camera: Float[ndarray, "4 4"],
    T_world_projector: Float[ndarray, "4 4"],
) -> tuple[Int64[ndarray, "m"], Float[ndarray, "m 2 2"]]:
    """Chosen vertices that face both devices, project into image and pattern, and are hidden from neither.

    With the pixels at which camera and projector have them.
    """
    poses = T_world_camera, T_world_projector
    packed = np.stack(list(map(packed_device, (camera, projector), poses)))
    uv, faces = np.empty((len(chosen), 2, 2)), np.empty(len(chosen), np.bool_)
    _project_facing(len(chosen), vertices, normals, chosen, packed, uv, faces)
    left = np.flatnonzero(faces)
    for T in poses:
        left = left[~occluder.hidden(vertices, normals, chosen[left], np.asarray(T[:3, 3], dtype=np.float64))]
    return chosen[left], uv[left]


def packed_device(device: Device, T_world_device: Float[ndarray, "4 4"]) -> Float[ndarray, "26"]:
    """A device for compiled loops: its pose's inverse, where it is, parameters, code, and size of the image."""
    T = np.asarray(T_world_device, dtype=np.float64)
    R, t = T[:3, :3], T[:3, 3]
    world = np.concatenate([R.T, -R.T @ t[:, None]], 1)
    numbers = [float(x) for x in (MODELS[device.model].code, device.w, device.h)]
    return np.concatenate([world.reshape(-1), t, Intrinsics.of(device, torch.float64).params.numpy(), numbers])


@compiled_range
def _project_facing(first, last, vertices, normals, chosen, devices, uv, faces):
    """Pixels `uv` (c, devices, 2) of chosen vertices; whether they face all devices (26 numbers) and are inside."""
    for i in range(first, last):
        faces[i] = True
        x, y, z = vertices[chosen[i]]
        a, b, c = normals[chosen[i]]
        for k in range(len(devices)):
            d = devices[k]
            if not (d[EYE] - x) * a + (d[EYE + 1] - y) * b + (d[EYE + 2] - z) * c > 0:
                faces[i] = False
                break
        if not faces[i]:
            continue
        for k in range(len(devices)):
            d = devices[k]
            X, Y, Z = moved(d, WORLD, x, y, z)
            found = view_of(d[CODE], X, Y, Z, d[PARAMETERS:CODE])
            u, v = found[0], found[1]
            uv[i, k, 0], uv[i, k, 1] = u, v
            if not (found[2] and 0 <= u < d[WIDTH] and 0 <= v < d[HEIGHT]):
                faces[i] = False
                break


@compiled_range
def _write_rays(first, last, points, normals, chosen, eye, start, centre, scale, rays):
    """Rays (n, 6) from beside chosen points of the surface to the eye, in units of `scale` around `centre`."""
    for i in range(first, last):
        j = chosen[i]
        x, y, z = eye[0] - points[j, 0], eye[1] - points[j, 1], eye[2] - points[j, 2]
        distance = (x * x + y * y + z * z) ** 0.5
        for k in range(3):
            begin = points[j, k] + start * (normals[j, k] + (eye[k] - points[j, k]) / distance)
            rays[i, k] = (begin - centre[k]) * scale
            rays[i, 3 + k] = (eye[k] - begin) * scale


def dot(a: Float[ndarray, "n k"], b: Float[ndarray, "n k"]) -> Float[ndarray, "n"]:
    """Dot products of rows; `(a * b).sum(1)` takes five times as long."""
    return np.einsum("nk,nk->n", a, b)


LEAST_PX, MOST_PX, MEDIANS = 2.0, 16.0, 6.0
"""A prediction agrees with a decoded coordinate within MEDIANS times the frame's median residual, kept between
LEAST_PX (decoding noise is smaller) and MOST_PX (with larger errors, the poses are too wrong to confirm anything)."""

OFF_MASK_PX = 3
"""A vertex that should be lit but projects farther than this outside the mask, in camera pixels, is not on the object.
If it is closer, the poses or the border of the mask may be slightly wrong, and the contradiction counts half."""

ENOUGH = 3  # a vertex with this many more confirmations than contradictions is not checked in further frames


@dataclass(frozen=True)
class FrameCounts:
    """Number of frames that should see and light each vertex, by what was decoded there."""

    confirmed: Int64[ndarray, "v"]  # the decoded coordinate is the one that the vertex predicts
    inconclusive: Int64[ndarray, "v"]  # in the mask, but what was decoded nearby, if anything, proves nothing
    contradicted: Int64[ndarray, "v"]  # another coordinate was decoded, or the vertex is outside the mask
    near_mask: Int64[ndarray, "v"]  # the vertex is outside the mask, but within OFF_MASK_PX of it
    residual_px: Float[ndarray, "n"]  # median of each frame; NaN where nothing was decoded on the mesh

    @property
    def against(self) -> Float[ndarray, "v"]:
        """Weighted number of contradictions of each vertex; frames that see it just outside the mask count half.

        A frame that looks along a surface cannot show where the surface ends. At the lower edge of a plate it confirms
        what is a pixel below, which is a millimetre there, while frames that face the plate see the vertex just outside
        the mask.
        """
        return self.contradicted + 0.5 * self.near_mask

    @property
    def decided(self) -> Bool[ndarray, "v"]:
        """Vertices that need not be checked in further frames."""
        return self.confirmed - self.against >= ENOUGH


def count_frames(
    mesh: Mesh, occluder: Occluder, scan: Scan, poses: DevicePoses, before: FrameCounts | None = None
) -> FrameCounts:
    """Check every undecided vertex in every frame; one frame's mask and coordinates are in memory at a time.

    `before` are the counts with more occluders: vertices decided there stay as they are, the others are counted again.
    """
    begun = np.zeros((4, len(mesh.vertices)), dtype=np.int64)
    if before is not None:
        earlier = np.stack([before.confirmed, before.inconclusive, before.contradicted, before.near_mask])
        begun = np.where(before.decided, earlier, 0)
    counts = FrameCounts(*begun, residual_px=np.zeros(0))
    normals = mesh.vertex_normals()
    medians: list[float] = []
    # A frame's median must not come from doubtful vertices alone: some are checked in all frames.
    always = np.arange(len(mesh.vertices)) % 8 == 0
    was_undecided = ~counts.decided
    frames = list(zip(scan.frames, poses.T_world_camera, poses.T_world_projector, strict=True))
    for frame, T_camera, T_projector in track(frames, "trimming to what was observed"):
        checked = np.flatnonzero(always | ~counts.decided)
        view = visible_vertices(mesh.vertices, normals, checked, occluder, frame, scan.projector, T_camera, T_projector)
        vertex = view.vertex
        known = view.most[always[vertex] & np.isfinite(view.most)]
        medians.append(float(np.median(known)) if len(known) else float("nan"))
        threshold = np.clip(MEDIANS * medians[-1], LEAST_PX, MOST_PX)
        agrees, differs = view.most <= threshold, (view.least > threshold) | view.off_mask
        new = was_undecided[vertex]
        counts.confirmed[vertex] += new & agrees
        counts.contradicted[vertex] += new & differs
        counts.near_mask[vertex] += new & view.near_mask
        counts.inconclusive[vertex] += new & ~agrees & ~differs & ~view.near_mask
    return replace(counts, residual_px=np.array(medians))


@dataclass(frozen=True)
class VisibleVertices:
    """The vertices that one frame should see and light, compared with what it decoded; distances in pattern pixels."""

    vertex: Int64[ndarray, "m"]
    off_mask: Bool[ndarray, "m"]  # farther than OFF_MASK_PX outside the mask
    near_mask: Bool[ndarray, "m"]  # outside the mask, but within OFF_MASK_PX of it
    least: Float[ndarray, "m"]  # lower bound of the distance between decoded and predicted coordinate; NaN if unknown
    most: Float[ndarray, "m"]  # upper bound


def visible_vertices(
    vertices: Float[ndarray, "v 3"],
    normals: Float[ndarray, "v 3"],
    chosen: Int64[ndarray, "c"],
    occluder: Occluder,
    frame: Frame,
    projector: Device,
    T_world_camera: Float[ndarray, "4 4"],
    T_world_projector: Float[ndarray, "4 4"],
) -> VisibleVertices:
    """Chosen vertices that a frame should see and light (see `lit_vertices`), compared with what it decoded."""
    T = T_world_camera, T_world_projector
    lit, uv = lit_vertices(vertices, normals, chosen, occluder, frame.camera, projector, *T)
    mask, coords, count = frame.read_mask(), frame.read_coords(), len(lit)
    offsets, outside = np.full((count, 2), np.nan), np.empty((count, 2), np.bool_)
    packed = np.stack(list(map(packed_device, (frame.camera, projector), T)))
    images = coords, mask, np.asarray(binary_dilation(mask, np.ones((3, 3), dtype=bool), iterations=OFF_MASK_PX))
    compare_decoded(count, vertices, normals, lit, uv, *images, packed, MOST_PX, offsets, outside)
    off, out = outside.T
    return VisibleVertices(lit, off, out & ~off, *offsets.T)


# Trim a mesh to what the frames observed: the field invents the surface that closes unseen sides.

HOLE_SHARE, UNDECODED_HOLE_SHARE, PIECE_SHARE = 2e-3, 2e-2, 1e-4
"""Shares of the kept area. Smaller gaps inside the observed surface stay closed (the second limit is for gaps where the
pattern was seen but not decoded); smaller separate pieces are dropped."""
UNDECODED_MEMBERS, CONTRADICTED = 0.75, 0.25
"""A gap counts as seen but not decoded if more than the first share of its vertices have inconclusive frames, and the
contradictions are fewer than the second share of the inconclusive counts: surface that wrongly closes a real gap
between two surfaces is contradicted by the frames that see through it."""
TINY = 3  # vertices: such a small gap is always closed, because wrong decodings can coincide by chance
BADLY_DECODED = 0.25  # share of inconclusive counts above which the mask alone counts as evidence
_SEVERAL = 2  # frames that contradict a vertex: one alone may have decoded wrongly
_LEAST_SHARE = 0.1  # of the seen vertices must be observed: with fewer, the agreement is chance
_SECOND_PASS_SHARE = 1e-3  # of all vertices: if more are contradicted, they are removed and all frames counted again


@dataclass(frozen=True)
class Trimmed:
    """The observed part of a mesh, and why the rest was removed; counts of vertices."""

    mesh: Mesh
    kept: Bool[ndarray, "f"]  # triangles of the whole mesh
    observed: Bool[ndarray, "v"]  # vertices of the whole mesh; those of closed gaps are not
    denied: Bool[ndarray, "v"]  # vertices of the whole mesh that several frames contradict
    total: int
    unseen: int  # no frame saw them
    contradicted: int  # frames saw something else there, or nothing
    closed: int  # kept although not observed: small gaps inside the observed surface
    loose_pieces: int  # pieces (not vertices) that were too small, or that no frame confirmed
    residual_px: float  # between predicted and decoded coordinates, median over frames; NaN if nothing was decoded


def trim_to_observed(mesh: Mesh, scan: Scan, poses: DevicePoses | None = None) -> Trimmed:
    """Keep the triangles of a mesh in world units whose corners at least one frame observed.

    A frame confirms a vertex that faces its camera and its projector, is hidden from neither, is inside the mask and
    inside the pattern, and whose predicted pattern coordinate is the decoded one. A frame contradicts it if it decoded
    another coordinate, or if the vertex is outside the mask although it should be lit. The majority decides; frames
    that see the vertex just outside their mask count half.
    The default is the scan's own poses; give the refined ones if the mesh was made with them. Raises UserError if
    nothing was observed.
    """
    poses = scan.poses if poses is None else poses
    counts = count_frames(mesh, Occluder(mesh), scan, poses)
    contradicted = _contradicted(counts)
    if contradicted.sum() > _SECOND_PASS_SHARE * len(contradicted):
        # Invented surface in front of the object may have hidden the object: count again without it.
        without = _without(mesh, contradicted, _observed(counts))
        if len(without.faces):
            counts = count_frames(mesh, Occluder(without), scan, poses, before=counts)
    observed = _observed(counts)
    seen = counts.confirmed + counts.inconclusive + counts.contradicted > 0
    if observed.sum() < _LEAST_SHARE * seen.sum() or not observed[mesh.faces].all(1).any():
        raise UserError(_nothing_observed(counts))
    keep = observed | _small_gaps(mesh, observed, counts)
    kept = keep[mesh.faces].all(1)
    loose, pieces = _loose_pieces(mesh, kept, counts)
    kept &= ~loose
    return Trimmed(
        mesh=mesh.with_faces(kept),
        kept=kept,
        observed=observed,
        denied=~observed & (counts.contradicted >= _SEVERAL),
        total=len(mesh.vertices),
        unseen=int((~seen).sum()),
        contradicted=int(_contradicted(counts).sum()),
        closed=int((keep & ~observed).sum()),
        loose_pieces=pieces,
        residual_px=float(np.nanmedian(counts.residual_px)) if np.isfinite(counts.residual_px).any() else float("nan"),
    )


def _observed(counts: FrameCounts) -> Bool[ndarray, "v"]:
    """Confirmed at least as often as contradicted; or never confirmed, but inconclusive more often than contradicted.

    The latter only in scans that were decoded badly. Where decoding rarely fails, real surface is confirmed by some
    frame, and what is in masks without ever being confirmed is the invented continuation of a visible side. The little
    real surface that is undecoded there is a gap, which `_small_gaps` closes.
    """
    by_code = (counts.confirmed > 0) & (counts.confirmed >= counts.against)
    by_mask = (counts.confirmed == 0) & (counts.inconclusive > counts.against)
    inconclusive, confirmed = int(counts.inconclusive.sum()), int(counts.confirmed.sum())
    return by_code | by_mask if inconclusive > BADLY_DECODED * (inconclusive + confirmed) else by_code


def _contradicted(counts: FrameCounts) -> Bool[ndarray, "v"]:
    return ~_observed(counts) & (counts.contradicted > 0)


def _without(mesh: Mesh, contradicted: Bool[ndarray, "v"], observed: Bool[ndarray, "v"]) -> Mesh:
    """The mesh without contradicted vertices, and without the pieces of invented surface that this leaves behind."""
    edges = mesh.edges()
    count, label = _components(len(contradicted), edges[~contradicted[edges].any(1)])
    real = np.bincount(label, observed, count) > 0
    return mesh.with_faces((~contradicted & real[label])[mesh.faces].all(1))


def _components(n: int, edges: Int64[ndarray, "e 2"]) -> tuple[int, Int64[ndarray, "n"]]:
    label = component_labels(edges[:, 0], edges[:, 1], n)
    return int(label.max(initial=-1)) + 1, label


def _small_gaps(mesh: Mesh, observed: Bool[ndarray, "v"], counts: FrameCounts) -> Bool[ndarray, "v"]:
    """Vertices of small unobserved patches inside the observed surface: tiny, or not contradicted by several frames."""
    edges = mesh.edges()
    gap = ~observed
    count, label = _components(len(gap), edges[gap[edges].all(1)])
    face_gap = gap[mesh.faces]
    touched = face_gap.any(1)
    face_label = np.where(face_gap, label[mesh.faces], -1).max(1)  # corners are neighbours, so they are in one patch
    areas = mesh.face_areas()
    area = np.bincount(face_label[touched], areas[touched], count)
    bordering = np.zeros(count, dtype=bool)
    mixed = edges[observed[edges[:, 0]] != observed[edges[:, 1]]]
    bordering[label[mixed[gap[mixed]]]] = True
    silence, denial = counts.inconclusive, counts.contradicted
    members, several, in_mask, silent, denied = (
        np.bincount(label[gap], values[gap].astype(float), count)
        for values in (gap, denial >= _SEVERAL, silence > 0, silence, denial)
    )
    undecoded = (in_mask > UNDECODED_MEMBERS * members) & (denied < CONTRADICTED * silent)
    share = np.where(undecoded, UNDECODED_HOLE_SHARE, HOLE_SHARE)
    allowed = (several <= 0.5 * members) | (members <= TINY)
    good = bordering & (area < share * areas[~touched].sum()) & allowed
    return gap & good[label]


def _loose_pieces(mesh: Mesh, kept: Bool[ndarray, "f"], counts: FrameCounts) -> tuple[Bool[ndarray, "f"], int]:
    """Kept triangles in pieces that are tiny or that no decoded coordinate confirms, and the number of those pieces."""
    faces = mesh.faces[kept]
    count, label = _components(len(mesh.vertices), np.concatenate([faces[:, :2], faces[:, 1:]]))
    area = np.bincount(label[faces[:, 0]], mesh.face_areas()[kept], count)
    confirmed = np.bincount(label, (counts.confirmed > 0).astype(float), count)
    bad = area < PIECE_SHARE * area.sum()
    if counts.confirmed.any():
        bad |= confirmed == 0
    pieces = np.unique(label[faces[:, 0]])
    return kept & bad[label[mesh.faces[:, 0]]], int(bad[pieces].sum())


def _nothing_observed(counts: FrameCounts) -> str:
    if (counts.contradicted > 0).any():
        off = f"they differ by {np.nanmedian(counts.residual_px):.0f} px (median)"
        cause = f"the predicted pattern coordinates are not the decoded ones; {off}"
    else:
        cause = "no vertex that faces camera and projector is inside a mask"
    return (
        "the frames observed no part of the surface, so nothing is left of it\n"
        f"    cause:  {cause}: wrong poses or axes, or an unfinished training\n"
        "    remedy: train it to its last step; if that was done, find the poses anew with sl-process, from the "
        "photographs; --keep-unobserved writes the whole surface"
    )
