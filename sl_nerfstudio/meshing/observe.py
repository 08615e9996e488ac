"""What the frames say about every vertex of a mesh: seen and confirmed, seen only, seen and denied, or not seen."""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from numpy import ndarray
from scipy.ndimage import binary_dilation

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project
from sl_nerfstudio.geometry.rays import pixel_rays
from sl_nerfstudio.geometry.se3 import inverse, transform
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.progress import track
from sl_nerfstudio.scan.types import Frame, Scan

LEAST_PX, MOST_PX, MEDIANS = 2.0, 16.0, 6.0
"""A prediction agrees with a decoded coordinate within MEDIANS times the frame's median residual, kept between
LEAST_PX (decoding noise stays below it) and MOST_PX (beyond, the poses are too bad to confirm anything)."""

OFF_MASK_PX = 3
"""Farther than this beside the mask, in camera pixels, a vertex that should be lit is none of the object's. Nearer,
poses and the mask's border may be to blame, and a frame's word against the vertex counts half."""

ENOUGH = 3  # confirmations more than denials: further frames are not asked about the vertex


@dataclass(frozen=True)
class Votes:
    """Number of frames that should see and light each vertex, by what they decoded there."""

    confirmed: Int64[ndarray, "v"]  # the decoded coordinate is the one that the vertex predicts
    silent: Int64[ndarray, "v"]  # the pattern falls there, but what was decoded nearby, if anything, proves nothing
    denied: Int64[ndarray, "v"]  # another coordinate was decoded, or the pattern does not fall there although it should
    beside: Int64[ndarray, "v"]  # the pattern does not fall there, but it does within OFF_MASK_PX
    residual_px: Float[ndarray, "n"]  # median of each frame; NaN where nothing was decoded on the mesh

    @property
    def against(self) -> Float[ndarray, "v"]:
        """What speaks against each vertex, in denials.

        Frames that look along a surface cannot tell how far it reaches: at the lower edge of a plate they confirm what
        lies a pixel below it, which is a millimetre there, while those that face it see the vertex beside the mask.
        """
        return self.denied + 0.5 * self.beside

    @property
    def settled(self) -> Bool[ndarray, "v"]:
        """Vertices about which no further frame is asked."""
        return self.confirmed - self.against >= ENOUGH


class Occluder:
    """Tells whether a mesh stands between its own vertices and a device."""

    def __init__(self, mesh: Mesh) -> None:
        """`mesh` may be open; both of its sides hide what lies behind them."""
        import open3d as o3d

        self._o3d = o3d
        self._centre = mesh.vertices.mean(0)
        self._scale = 1 / max(float(np.ptp(mesh.vertices, axis=0).max()), 1e-300)
        self._start = 2 * mesh.edge_length()
        self._scene = o3d.t.geometry.RaycastingScene()
        vertices = ((mesh.vertices - self._centre) * self._scale).astype(np.float32)
        self._scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(mesh.faces.astype(np.uint32)))

    def hidden(
        self, points: Float[ndarray, "n 3"], normals: Float[ndarray, "n 3"], eye: Float[ndarray, "3"]
    ) -> Bool[ndarray, "n"]:
        """Whether the mesh stands between points on it, facing `eye`, and `eye`.

        Rays start two edge lengths off the surface, along the normal and towards the eye, so that none hits its own.
        """
        way = eye - points
        distance = np.sqrt(_dot(way, way))[:, None]
        start = points + self._start * (normals + way / distance)
        rays = np.concatenate([(start - self._centre) * self._scale, (eye - start) * self._scale], 1).astype(np.float32)
        return self._scene.test_occlusions(self._o3d.core.Tensor(rays), tnear=0.0, tfar=1.0).numpy()


def collect_votes(
    mesh: Mesh,
    occluder: Occluder,
    scan: Scan,
    T_world_camera: Float[ndarray, "n 4 4"],
    T_world_projector: Float[ndarray, "n 4 4"],
    before: Votes | None = None,
) -> Votes:
    """Ask every frame about every vertex that is not settled; one frame's mask and coordinates are in memory at a time.

    `before`: votes with more occluders. What was settled then stays so, the others are asked anew.
    """
    votes = _begin(mesh, before)
    confirmed, silent, denied, beside = votes.confirmed, votes.silent, votes.denied, votes.beside
    normals = mesh.vertex_normals()
    medians: list[float] = []
    # A frame's median must not come from disputed vertices alone: some are asked to the end.
    always = np.arange(len(mesh.vertices)) % 8 == 0
    still_open = ~votes.settled
    poses = list(zip(scan.frames, T_world_camera, T_world_projector, strict=True))
    for frame, T_camera, T_projector in track(poses, "cutting to what was observed"):
        asked = np.flatnonzero(always | ~votes.settled)
        view = observe_vertices(
            mesh.vertices[asked], normals[asked], occluder, frame, scan.projector, T_camera, T_projector
        )
        vertex = asked[view.vertex]
        known = view.most[always[vertex] & np.isfinite(view.most)]
        medians.append(float(np.median(known)) if len(known) else float("nan"))
        threshold = np.clip(MEDIANS * medians[-1], LEAST_PX, MOST_PX)
        agrees, differs = view.most <= threshold, (view.least > threshold) | view.off_mask
        new = still_open[vertex]
        confirmed[vertex] += new & agrees
        denied[vertex] += new & differs
        beside[vertex] += new & view.beside
        silent[vertex] += new & ~agrees & ~differs & ~view.beside
    return replace(votes, residual_px=np.array(medians))


def _begin(mesh: Mesh, before: Votes | None) -> Votes:
    """No votes, but those of settled vertices."""
    if before is None:
        confirmed, silent, denied, beside = np.zeros((4, len(mesh.vertices)), dtype=np.int64)
    else:
        kept = before.settled
        confirmed, silent, denied, beside = (
            np.where(kept, v, 0) for v in (before.confirmed, before.silent, before.denied, before.beside)
        )
    return Votes(confirmed, silent, denied, beside, np.zeros(0))


@dataclass(frozen=True)
class FrameObservation:
    """What one frame says about the vertices that it should see and light; distances in pattern pixels."""

    vertex: Int64[ndarray, "m"]
    off_mask: Bool[ndarray, "m"]  # the pattern does not fall there, nor within OFF_MASK_PX
    beside: Bool[ndarray, "m"]  # it does not fall there, but within OFF_MASK_PX
    least: Float[ndarray, "m"]  # distance of the decoded from the predicted coordinate: at least; NaN if not known
    most: Float[ndarray, "m"]  # at most


def observe_vertices(
    vertices: Float[ndarray, "v 3"],
    normals: Float[ndarray, "v 3"],
    occluder: Occluder,
    frame: Frame,
    projector: Device,
    T_world_camera: Float[ndarray, "4 4"],
    T_world_projector: Float[ndarray, "4 4"],
) -> FrameObservation:
    """What a frame says about the vertices that it should see and light.

    They face camera and projector, fall inside image and pattern, and the mesh hides them from neither.
    """
    vertex = np.arange(len(vertices), dtype=np.int64)
    for T in (T_world_camera, T_world_projector):
        vertex = vertex[_faces(vertices[vertex], normals[vertex], T)]
    uv_camera, inside = _pixels(vertices[vertex], frame.camera, T_world_camera)
    vertex, uv_camera = vertex[inside], uv_camera[inside]
    uv_projector, inside = _pixels(vertices[vertex], projector, T_world_projector)
    vertex, uv_camera, uv_projector = vertex[inside], uv_camera[inside], uv_projector[inside]
    mask = frame.read_mask()
    for T in (T_world_camera, T_world_projector):
        free = ~occluder.hidden(vertices[vertex], normals[vertex], T[:3, 3])
        vertex, uv_camera, uv_projector = vertex[free], uv_camera[free], uv_projector[free]
    on_mask, near_mask = _look_up(mask, uv_camera), _look_up(_grown(mask, OFF_MASK_PX), uv_camera)
    least, most = np.full((2, len(vertex)), np.nan)
    lit, uv_camera, uv_projector = vertex[on_mask], uv_camera[on_mask], uv_projector[on_mask]
    jacobian = _jacobian(
        vertices[lit], normals[lit], uv_camera, uv_projector, frame.camera, T_world_camera, projector, T_world_projector
    )
    least[on_mask], most[on_mask] = _offset_from_decoded(frame.read_coords(), uv_camera, uv_projector, jacobian)
    return FrameObservation(vertex, ~near_mask, near_mask & ~on_mask, least, most)


def _grown(mask: Bool[ndarray, "h w"], pixels: int) -> Bool[ndarray, "h w"]:
    return np.asarray(binary_dilation(mask, np.ones((3, 3), dtype=bool), iterations=pixels))


def _look_up(mask: Bool[ndarray, "h w"], uv: Float[ndarray, "n 2"]) -> Bool[ndarray, "n"]:
    pixel = np.floor(uv).astype(np.int64)
    return mask[pixel[:, 1], pixel[:, 0]]


def _faces(
    points: Float[ndarray, "n 3"], normals: Float[ndarray, "n 3"], T: Float[ndarray, "4 4"]
) -> Bool[ndarray, "n"]:
    return _dot(T[:3, 3] - points, normals) > 0


def _dot(a: Float[ndarray, "n k"], b: Float[ndarray, "n k"]) -> Float[ndarray, "n"]:
    """Products of rows; `(a * b).sum(1)` takes five times as long."""
    return np.einsum("nk,nk->n", a, b)


def _pixels(
    points: Float[ndarray, "n 3"], device: Device, T_world_device: Float[ndarray, "4 4"]
) -> tuple[Float[ndarray, "n 2"], Bool[ndarray, "n"]]:
    """Pixels of world points, and which of them lie inside the image and in front of the device."""
    T = inverse(torch.as_tensor(T_world_device, dtype=torch.float64))
    uv, in_front = project(Intrinsics.of(device, torch.float64), transform(T, torch.from_numpy(points)))
    uv = uv.numpy()
    u, v = uv.T
    return uv, in_front.numpy() & (u >= 0) & (v >= 0) & (u < device.w) & (v < device.h)


def _jacobian(
    points: Float[ndarray, "n 3"],
    normals: Float[ndarray, "n 3"],
    uv_camera: Float[ndarray, "n 2"],
    uv_projector: Float[ndarray, "n 2"],
    camera: Device,
    T_world_camera: Float[ndarray, "4 4"],
    projector: Device,
    T_world_projector: Float[ndarray, "4 4"],
) -> Float[ndarray, "n 2 2"]:
    """How the predicted coordinate moves, in its first index, with a camera pixel's x and y on the tangent plane."""
    columns = []
    for step in ((1.0, 0.0), (0.0, 1.0)):
        uv = torch.from_numpy(uv_camera + step)
        origin, direction = pixel_rays(Intrinsics.of(camera, torch.float64), torch.from_numpy(T_world_camera), uv)
        o, d = origin.numpy(), direction.numpy()
        towards = _dot(d, normals)
        distance = _dot(points - o, normals) / np.where(towards < 0, towards, -1e-12)
        there, _ = _pixels(o + distance[:, None] * d, projector, T_world_projector)
        columns.append((there - uv_projector).clip(-MOST_PX, MOST_PX))
    return np.stack(columns, -1)


def _offset_from_decoded(
    coords: Float[ndarray, "h w 2"],
    uv_camera: Float[ndarray, "n 2"],
    uv_projector: Float[ndarray, "n 2"],
    jacobian: Float[ndarray, "n 2 2"],
) -> tuple[Float[ndarray, "n"], Float[ndarray, "n"]]:
    """Least and greatest distance of predicted from decoded coordinates, NaN if nothing was decoded within a pixel.

    Where four decoded neighbours vary no more than `jacobian` lets expect, their bilinear value is compared. Else (an
    edge, or undecoded neighbours) it is the best of nine pixels, each against the prediction on the tangent plane; how
    far the surface may bend away from it, half of the plane's own change, makes the difference of the two distances.
    """
    slope = np.sqrt(np.einsum("nij,nij->n", jacobian, jacobian))
    column, row = np.floor(uv_camera - 0.5).astype(np.int64).T
    corners = [_at(coords, row + dy, column + dx) - uv_projector for dy, dx in product((0, 1), repeat=2)]
    spread = _length(np.maximum.reduce(corners) - np.minimum.reduce(corners))
    x, y = (uv_camera - 0.5 - np.stack([column, row], 1)).T[:, :, None]
    bilinear = (1 - y) * ((1 - x) * corners[0] + x * corners[1]) + y * ((1 - x) * corners[2] + x * corners[3])
    least = _length(bilinear)
    most = least.copy()
    torn = np.flatnonzero(~(spread <= 2 * slope + 1))  # NaN where a corner was not decoded
    least[torn], most[torn] = _best_of_nine(coords, uv_camera[torn], uv_projector[torn], jacobian[torn], slope[torn])
    return least, most


def _best_of_nine(
    coords: Float[ndarray, "h w 2"],
    uv_camera: Float[ndarray, "n 2"],
    uv_projector: Float[ndarray, "n 2"],
    jacobian: Float[ndarray, "n 2 2"],
    slope: Float[ndarray, "n"],
) -> tuple[Float[ndarray, "n"], Float[ndarray, "n"]]:
    """Least and greatest distance from the pixel, among nine, that agrees best with the tangent plane."""
    column, row = np.floor(uv_camera).astype(np.int64).T
    least, most = np.full(len(row), np.nan), np.full(len(row), np.nan)
    for dy, dx in product((-1, 0, 1), repeat=2):
        away = np.stack([column + dx, row + dy], 1) + 0.5 - uv_camera
        plane = np.einsum("nij,nj->ni", jacobian, away)
        distance = _length(_at(coords, row + dy, column + dx) - uv_projector - plane)
        bend = 0.5 * slope * _length(away)
        least, most = np.fmin(least, (distance - bend).clip(min=0)), np.fmin(most, distance)
    return least, most


def _at(
    coords: Float[ndarray, "h w 2"], row: Int64[ndarray, "n"], column: Int64[ndarray, "n"]
) -> Float[ndarray, "n 2"]:
    height, width = coords.shape[:2]
    return coords[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]


def _length(v: Float[ndarray, "n 2"]) -> Float[ndarray, "n"]:
    return np.hypot(v[:, 0], v[:, 1])
