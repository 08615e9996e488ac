"""For every vertex of a mesh, the frames that measured it: what they decoded there, and under which geometry."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Int64
from numpy import ndarray

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.settings import LookUpSettings
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.devices import Intrinsics
from sl_nerfstudio.geometry.robust import MAD_TO_SIGMA
from sl_nerfstudio.geometry.spacing import evenly_spaced
from sl_nerfstudio.meshing.lit_vertices import Occluder, lit_vertices
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.surface_derivatives import FrameDevices, SurfaceView, view_surface
from sl_nerfstudio.meshing.visibility import LEAST_PX, MEDIANS, MOST_PX
from sl_nerfstudio.progress import track
from sl_nerfstudio.scan.types import Frame, Scan
from sl_nerfstudio.threads import results, threads

_LOOKED_UP = 2000  # vertices of a frame, to compare the noise of windows with that of pixels
_FEWEST = 20  # values of which a spread is stated


@dataclass(frozen=True)
class VertexViews:
    """Pairs of a vertex and a frame that confirms it, by vertex; lengths in the scan's unit."""

    vertex: Int64[ndarray, "m"]
    frame: Int64[ndarray, "m"]
    slope: Float[ndarray, "m 2"]  # of the residual along the normal, projector pixels per unit of length
    residual: Float[ndarray, "m 2"]  # predicted minus decoded coordinate, projector pixels
    pixels_per_area: Float[ndarray, "m"]
    ray_angle: Float[ndarray, "m"]  # between the rays of camera and projector, radian
    noise_px: Float[ndarray, "frames"]  # 1 sigma of one pixel's coordinate, each component; NaN if unknown
    correlation: float  # how many neighbouring pixels share an error: 1 if their errors are independent


@dataclass(frozen=True)
class FrameViews:
    """The same of one frame."""

    vertex: Int64[ndarray, "m"]  # ascending
    slope: Float[ndarray, "m 2"]
    residual: Float[ndarray, "m 2"]
    pixels_per_area: Float[ndarray, "m"]
    ray_angle: Float[ndarray, "m"]
    noise_px: float
    window_ratio: float  # variance of a window's value over that of a pixel; NaN if unknown


def devices_of(scan: Scan, poses: DevicePoses, frame: int) -> FrameDevices:
    """The devices of one frame at the given poses."""
    T_camera = torch.from_numpy(poses.T_world_camera[frame])
    T_projector = torch.from_numpy(poses.T_world_projector[frame])
    camera = Intrinsics.of(scan.frames[frame].camera, torch.float64)
    return FrameDevices(
        camera, Intrinsics.of(scan.projector, torch.float64), T_camera, torch.linalg.inv(T_camera) @ T_projector
    )


def views_by_frame(
    mesh: Mesh, scan: Scan, poses: DevicePoses, chosen: Int64[ndarray, "c"] | None, task: str
) -> Iterator[FrameViews]:
    """Of each frame in order, what it confirms of a mesh, or of the `chosen` vertices; `task` names the progress.

    As many frames are in memory at a time as there are threads.
    """
    chosen = np.arange(len(mesh.vertices), dtype=np.int64) if chosen is None else chosen
    points, normals = mesh.vertices, mesh.vertex_normals()
    occluder, all_frames = Occluder(mesh), list(enumerate(scan.frames))
    for first in track(range(0, len(all_frames), threads()), task):
        frames = all_frames[first : first + threads()]
        yield from results(
            [partial(_views_of, points, normals, chosen, occluder, f, scan, poses, k) for k, f in frames]
        )


def collect_views(
    mesh: Mesh,
    scan: Scan,
    poses: DevicePoses,
    chosen: Int64[ndarray, "c"] | None = None,
    task: str = "uncertainty of the surface",
) -> VertexViews:
    """All frames that see, light and confirm each vertex (or each of the `chosen` ones), which takes memory for each.

    A frame confirms a vertex under the rules of `visibility`: its decoded coordinate is the one that the vertex
    predicts.
    """
    found = list(views_by_frame(mesh, scan, poses, chosen, task))
    vertex = np.concatenate([f.vertex for f in found])
    order = np.argsort(vertex, kind="stable")
    frame = np.repeat(np.arange(len(found)), [len(f.vertex) for f in found])

    def joined(name: str) -> ndarray:
        return np.concatenate([getattr(f, name) for f in found])[order]

    return VertexViews(
        vertex=vertex[order],
        frame=frame[order],
        slope=joined("slope"),
        residual=joined("residual"),
        pixels_per_area=joined("pixels_per_area"),
        ray_angle=joined("ray_angle"),
        noise_px=np.array([f.noise_px for f in found]),
        correlation=correlation_of([f.window_ratio for f in found]),
    )


def correlation_of(window_ratios: Sequence[float]) -> float:
    """How many neighbouring pixels share an error, from what windows gain in each frame (NaN: unknown)."""
    known = [ratio for ratio in window_ratios if np.isfinite(ratio)]
    return max(1.0, window_pixels() * float(np.median(known))) if known else 1.0


def _views_of(
    points: Float[ndarray, "v 3"],
    normals: Float[ndarray, "v 3"],
    chosen: Int64[ndarray, "c"],
    occluder: Occluder,
    frame: Frame,
    scan: Scan,
    poses: DevicePoses,
    k: int,
) -> FrameViews:
    seen = lit_vertices(
        points,
        normals,
        chosen,
        occluder,
        frame.camera,
        scan.projector,
        poses.T_world_camera[k],
        poses.T_world_projector[k],
    ).vertex
    devices, coords = devices_of(scan, poses, k), frame.read_coords()
    view = view_surface(devices, torch.from_numpy(points[seen]), torch.from_numpy(normals[seen]))
    uv = view.uv_camera.numpy()
    column, row = np.floor(uv).astype(np.int64).T
    at_pixel = np.einsum("nij,nj->ni", view.by_pixel.numpy(), np.stack([column, row], 1) + 0.5 - uv)
    residual = view.uv_projector.numpy() + at_pixel - coords[row, column]
    size = np.linalg.norm(residual, axis=1)
    known = np.isfinite(size)
    usual = float(np.median(size[known])) if known.any() else 0.0
    good = np.flatnonzero(known & (size <= np.clip(MEDIANS * usual, LEAST_PX, MOST_PX)))
    residual = residual[good]
    slope, pixels_per_area, ray_angle = (x.numpy()[good] for x in (view.slope, view.pixels_per_area, view.ray_angle))
    noise = _spread(_across(slope, residual))
    ratio = _window_ratio(coords, view, good, noise)
    return FrameViews(seen[good], slope, residual, pixels_per_area, ray_angle, noise, ratio)


def _across(slope: Float[ndarray, "m 2"], residual: Float[ndarray, "m 2"]) -> Float[ndarray, "m"]:
    """The component of residuals that no motion of the surface changes: noise, and errors of the poses."""
    return (slope[:, 0] * residual[:, 1] - slope[:, 1] * residual[:, 0]) / np.linalg.norm(slope, axis=1)


def _spread(values: Float[ndarray, "n"]) -> float:
    return float(np.median(np.abs(values))) * MAD_TO_SIGMA if len(values) >= _FEWEST else float("nan")


def _window_ratio(coords: Float[ndarray, "h w 2"], view: SurfaceView, good: Int64[ndarray, "m"], noise: float) -> float:
    """Variance of look-ups, which average a window, over that of single pixels; of the points that are good."""
    some = good[evenly_spaced(len(good), min(_LOOKED_UP, len(good)))]
    maps = CoordinateMaps.of([torch.from_numpy(coords)])
    seen = maps.look_up(torch.zeros(len(some), dtype=torch.int64), view.uv_camera[some])
    across = _across(view.slope.numpy()[some], (view.uv_projector[some] - seen.uv_projector).numpy())
    return (_spread(across[seen.valid.numpy()]) / noise) ** 2 if noise > 0 else float("nan")


def window_pixels(half: int = LookUpSettings().half_window) -> float:
    """How many independent pixels have the variance of one look-up in a window that is decoded throughout."""
    y, x = np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1).astype(float)
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], 1)
    return 1 / float(np.linalg.inv(basis.T @ basis)[0, 0])
