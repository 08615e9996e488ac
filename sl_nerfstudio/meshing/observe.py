"""What the frames say about every vertex of a mesh: seen and confirmed, seen only, seen and denied, or not seen."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from numpy import ndarray
from scipy.ndimage import binary_dilation

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project
from sl_nerfstudio.geometry.se3 import inverse, transform
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.progress import track
from sl_nerfstudio.scan.types import Frame, Scan

MASK_MARGIN = 1  # pixels around the mask that still count: a border pixel is only partly covered
LEAST_PX, MOST_PX, MEDIANS = 4.0, 32.0, 6.0
"""A prediction agrees with a decoded coordinate within MEDIANS times the frame's median residual, kept between
LEAST_PX (decoding noise and half a camera pixel of slope stay below it) and MOST_PX (beyond, poses prove nothing)."""


@dataclass(frozen=True)
class Votes:
    """Number of frames that saw each vertex, by what they decoded there."""

    confirmed: Int64[ndarray, "v"]  # the decoded coordinate is the one that the vertex predicts
    silent: Int64[ndarray, "v"]  # the pattern falls there, but nothing was decoded nearby
    denied: Int64[ndarray, "v"]  # another coordinate was decoded: the camera saw something else there
    threshold_px: Float[ndarray, "n"]  # of each frame, see LEAST_PX; NaN where nothing was decoded on the mesh


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

        Rays start two edge lengths off the surface, along the normal and towards the eye, so that no surface hides itself.
        """
        way = eye - points
        distance = np.linalg.norm(way, axis=1, keepdims=True)
        start = points + self._start * (normals + way / distance)
        rays = np.concatenate([(start - self._centre) * self._scale, (eye - start) * self._scale], 1).astype(np.float32)
        return self._scene.test_occlusions(self._o3d.core.Tensor(rays), tnear=0.0, tfar=1.0).numpy()


def collect_votes(
    mesh: Mesh,
    occluder: Occluder,
    scan: Scan,
    T_world_camera: Float[ndarray, "n 4 4"],
    T_world_projector: Float[ndarray, "n 4 4"],
) -> Votes:
    """Ask every frame about every vertex; one frame's mask and coordinates are in memory at a time."""
    confirmed, silent, denied = (np.zeros(len(mesh.vertices), dtype=np.int64) for _ in range(3))
    normals = mesh.vertex_normals()
    thresholds = []
    poses = list(zip(scan.frames, T_world_camera, T_world_projector, strict=True))
    for frame, T_camera, T_projector in track(poses, "cutting to what was observed"):
        vertex, residual = frame_residuals(mesh.vertices, normals, occluder, frame, scan.projector, T_camera, T_projector)
        threshold = agreement_threshold(residual)
        confirmed[vertex] += residual <= threshold
        denied[vertex] += residual > threshold
        silent[vertex] += np.isnan(residual)
        thresholds.append(threshold)
    return Votes(confirmed, silent, denied, np.array(thresholds))


def agreement_threshold(residual: Float[ndarray, "n"]) -> float:
    """Pattern pixels within which a frame's predictions agree with what it decoded; NaN if it decoded nothing there."""
    known = residual[np.isfinite(residual)]
    return float(np.clip(MEDIANS * np.median(known), LEAST_PX, MOST_PX)) if len(known) else float("nan")


def frame_residuals(
    vertices: Float[ndarray, "v 3"],
    normals: Float[ndarray, "v 3"],
    occluder: Occluder,
    frame: Frame,
    projector: Device,
    T_world_camera: Float[ndarray, "4 4"],
    T_world_projector: Float[ndarray, "4 4"],
) -> tuple[Int64[ndarray, "m"], Float[ndarray, "m"]]:
    """Vertices that the frame saw, and how far their predicted pattern coordinate is from the decoded one.

    Seen means: they face camera and projector, fall inside the mask and inside the pattern, and the mesh hides them from neither.
    The residual, in pattern pixels, is the smallest over the pixel and its eight neighbours; NaN if none of these was decoded.
    """
    vertex = np.arange(len(vertices), dtype=np.int64)
    vertex = vertex[_faces(vertices, normals, T_world_camera)]
    vertex = vertex[_faces(vertices[vertex], normals[vertex], T_world_projector)]
    uv_camera, inside = _pixels(vertices[vertex], frame.camera, T_world_camera)
    vertex, uv_camera = vertex[inside], uv_camera[inside]
    column, row = np.floor(uv_camera).astype(np.int64).T
    mask = binary_dilation(frame.read_mask(), np.ones((3, 3), dtype=bool), iterations=MASK_MARGIN)
    masked = mask[row, column]
    vertex, row, column = vertex[masked], row[masked], column[masked]
    uv_projector, inside = _pixels(vertices[vertex], projector, T_world_projector)
    vertex, row, column, uv_projector = vertex[inside], row[inside], column[inside], uv_projector[inside]
    for T in (T_world_camera, T_world_projector):
        free = ~occluder.hidden(vertices[vertex], normals[vertex], T[:3, 3])
        vertex, row, column, uv_projector = vertex[free], row[free], column[free], uv_projector[free]
    return vertex, _nearest_decoded(frame.read_coords(), row, column, uv_projector)


def _faces(points: Float[ndarray, "n 3"], normals: Float[ndarray, "n 3"], T: Float[ndarray, "4 4"]) -> Bool[ndarray, "n"]:
    return ((T[:3, 3] - points) * normals).sum(1) > 0


def _pixels(
    points: Float[ndarray, "n 3"], device: Device, T_world_device: Float[ndarray, "4 4"]
) -> tuple[Float[ndarray, "n 2"], Bool[ndarray, "n"]]:
    """Pixels of world points, and which of them lie inside the image and in front of the device."""
    T = inverse(torch.as_tensor(T_world_device, dtype=torch.float64))
    uv, in_front = project(Intrinsics.of(device, torch.float64), transform(T, torch.from_numpy(points)))
    uv = uv.numpy()
    return uv, in_front.numpy() & (uv >= 0).all(1) & (uv < (device.w, device.h)).all(1)


def _nearest_decoded(
    coords: Float[ndarray, "h w 2"], row: Int64[ndarray, "n"], column: Int64[ndarray, "n"], uv: Float[ndarray, "n 2"]
) -> Float[ndarray, "n"]:
    height, width = coords.shape[:2]
    best = np.full(len(row), np.inf)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            decoded = coords[np.clip(row + dy, 0, height - 1), np.clip(column + dx, 0, width - 1)]
            best = np.fmin(best, np.linalg.norm(decoded - uv, axis=1))
    return np.where(np.isinf(best), np.nan, best)
