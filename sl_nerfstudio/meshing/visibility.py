"""For every vertex of a mesh, how many frames see it, and how many of them confirm or contradict it."""

from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from numpy import ndarray
from scipy.ndimage import binary_dilation

from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.devices import Device, Intrinsics
from sl_nerfstudio.geometry.rays import pixel_rays, world_pixels
from sl_nerfstudio.meshing.lit_vertices import LitVertices, Occluder, dot, lit_vertices
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.progress import track
from sl_nerfstudio.scan.types import Frame, Scan
from sl_nerfstudio.threads import results, split, threads

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
    counts = _begin(mesh, before)
    normals = mesh.vertex_normals()
    medians: list[float] = []
    # A frame's median must not come from doubtful vertices alone: some are checked in all frames.
    always = np.arange(len(mesh.vertices)) % 8 == 0
    was_undecided = ~counts.decided
    frames = list(zip(scan.frames, poses.T_world_camera, poses.T_world_projector, strict=True))
    for frame, T_camera, T_projector in track(frames, "trimming to what was observed"):
        checked = np.flatnonzero(always | ~counts.decided)
        view = visible_vertices(
            mesh.vertices[checked], normals[checked], occluder, frame, scan.projector, T_camera, T_projector
        )
        vertex = checked[view.vertex]
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


def _begin(mesh: Mesh, before: FrameCounts | None) -> FrameCounts:
    """Zero for every vertex, except for those that are decided."""
    if before is None:
        counts = np.zeros((4, len(mesh.vertices)), dtype=np.int64)
    else:
        earlier = np.stack([before.confirmed, before.inconclusive, before.contradicted, before.near_mask])
        counts = np.where(before.decided, earlier, 0)
    return FrameCounts(*counts, residual_px=np.zeros(0))


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
    occluder: Occluder,
    frame: Frame,
    projector: Device,
    T_world_camera: Float[ndarray, "4 4"],
    T_world_projector: Float[ndarray, "4 4"],
) -> VisibleVertices:
    """The vertices that a frame should see and light (see `lit_vertices`), compared with what it decoded."""
    devices = (frame.camera, projector, T_world_camera, T_world_projector)
    lit = lit_vertices(vertices, normals, occluder, *devices)
    mask, coords = frame.read_mask(), frame.read_coords()
    on_mask, around_mask = _look_up(mask, lit.uv_camera), _look_up(_grown(mask, OFF_MASK_PX), lit.uv_camera)
    least, most = np.full((2, len(lit.vertex)), np.nan)
    compared = np.flatnonzero(on_mask)
    parts = results(
        [
            partial(_compared, vertices, normals, lit, compared[first:last], coords, *devices)
            for first, last in split(len(compared), threads(), 1)
        ]
    )
    least[compared], most[compared] = np.concatenate(parts, 1)
    return VisibleVertices(lit.vertex, ~around_mask, around_mask & ~on_mask, least, most)


def _compared(
    vertices: Float[ndarray, "v 3"],
    normals: Float[ndarray, "v 3"],
    lit: LitVertices,
    part: Int64[ndarray, "n"],
    coords: Float[ndarray, "h w 2"],
    camera: Device,
    projector: Device,
    T_world_camera: Float[ndarray, "4 4"],
    T_world_projector: Float[ndarray, "4 4"],
) -> Float[ndarray, "2 n"]:
    """Bounds of the distance between predicted and decoded coordinates, for a part of the lit vertices."""
    vertex, uv_camera, uv_projector = lit.vertex[part], lit.uv_camera[part], lit.uv_projector[part]
    jacobian = _jacobian(
        *(vertices[vertex], normals[vertex], uv_camera, uv_projector),
        *(camera, T_world_camera, projector, T_world_projector),
    )
    return np.stack(_offset_from_decoded(coords, uv_camera, uv_projector, jacobian))


def _grown(mask: Bool[ndarray, "h w"], pixels: int) -> Bool[ndarray, "h w"]:
    return np.asarray(binary_dilation(mask, np.ones((3, 3), dtype=bool), iterations=pixels))


def _look_up(mask: Bool[ndarray, "h w"], uv: Float[ndarray, "n 2"]) -> Bool[ndarray, "n"]:
    pixel = np.floor(uv).astype(np.int64)
    return mask[pixel[:, 1], pixel[:, 0]]


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
    """Derivative of the predicted coordinate (first index) by the camera pixel's x and y, on the tangent plane."""
    columns = []
    for step in ((1.0, 0.0), (0.0, 1.0)):
        uv = torch.from_numpy(uv_camera + step)
        origin, direction = pixel_rays(Intrinsics.of(camera, torch.float64), torch.from_numpy(T_world_camera), uv)
        o, d = origin.numpy(), direction.numpy()
        towards = dot(d, normals)
        distance = dot(points - o, normals) / np.where(towards < 0, towards, -1e-12)
        there, _ = world_pixels(projector, T_world_projector, o + distance[:, None] * d)
        columns.append((there - uv_projector).clip(-MOST_PX, MOST_PX))
    return np.stack(columns, -1)


def _offset_from_decoded(
    coords: Float[ndarray, "h w 2"],
    uv_camera: Float[ndarray, "n 2"],
    uv_projector: Float[ndarray, "n 2"],
    jacobian: Float[ndarray, "n 2 2"],
) -> tuple[Float[ndarray, "n"], Float[ndarray, "n"]]:
    """Bounds of the distance between predicted and decoded coordinates, NaN if nothing was decoded within a pixel.

    Where four decoded neighbours vary no more than `jacobian` predicts, their bilinear value is compared. Otherwise (an
    edge, or undecoded neighbours) the best of nine pixels is used, each compared with the prediction on the tangent
    plane. The surface may bend away from that plane by half of the plane's own change, which is the difference between
    the two bounds.
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
    """Bounds of the distance for the pixel, of nine, that agrees best with the tangent plane."""
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
