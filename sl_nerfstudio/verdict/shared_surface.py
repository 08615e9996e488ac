"""How much of the surface that other frames show did a frame decode?

Of the visible pattern, a part may lie on a table or a wall far behind the object, too fine or too blurred to be
decoded. That says nothing against the frame. What the others decoded does: it is there, and can be decoded.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.observations import place_anchors
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.rays import world_pixels
from sl_nerfstudio.geometry.se3 import rotate, transform
from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.scan.types import Scan
from sl_nerfstudio.threads import one_library_thread
from sl_nerfstudio.verdict.settings import CrossFrameSettings


@dataclass(frozen=True)
class SurfacePoints:
    """Points of all frames, spread over what each decoded."""

    p_world: Float64[ndarray, "n 3"]
    normal: Float64[ndarray, "n 3"]
    source: Int64[ndarray, "n"]  # the frame that shows it

    def sights(self, centre: Float64[ndarray, "3"]) -> tuple[Float64[ndarray, "n"], Float64[ndarray, "n"]]:
        """Distances from a device at `centre`, and the cosines between the normals and the way there."""
        sight = centre - self.p_world
        distance = np.linalg.norm(sight, axis=1)
        return distance, (sight * self.normal).sum(1) / distance


@dataclass(frozen=True)
class SurfaceShares:
    """What one frame has of the surface that others show; None where too little is known."""

    decoded: float | None  # see `shared_surface`
    missing: float | None  # see `missing_surface.missing_shares`


@dataclass(frozen=True)
class SharedSurface:
    """What the frames of a scan show of each other's surface."""

    points: SurfacePoints
    decoded: tuple[float | None, ...]  # see `shared_surface`


def shared_surface_of_scan(scan: Scan, settings: CrossFrameSettings | None = None) -> SharedSurface:
    """The same as `shared_surface`, with the files of a scan and its own poses."""
    return shared_surface(
        [f.camera for f in scan.frames],
        scan.projector,
        scan.poses,
        (f.read_coords() for f in scan.frames),
        (f.read_mask() for f in scan.frames),
        settings,
    )


@one_library_thread()
def shared_surface(
    cameras: Sequence[Device],
    projector: Device,
    poses: DevicePoses,
    coords: Iterable[Float32[ndarray, "_h _w 2"]],
    masks: Iterable[Bool[ndarray, "_h _w"]],
    settings: CrossFrameSettings | None = None,
) -> SharedSurface:
    """Of the points of other frames that lie where a frame sees the pattern, the share that it decoded.

    `masks`: where each frame sees the pattern. None for a frame on which too few points lie.
    """
    s = settings or CrossFrameSettings()
    maps = CoordinateMaps.of(torch.from_numpy(image) for image in coords)
    points = _points(Rig.of(cameras, projector, poses, Similarity.identity()), maps, s)
    shares: list[float | None] = []
    for k, mask in enumerate(masks):
        uv, inside = world_pixels(cameras[k], poses.T_world_camera[k], points.p_world)
        _, cosine = points.sights(poses.T_world_camera[k, :3, 3])
        column, row = uv[inside & (cosine > s.least_cosine) & (points.source != k)].astype(np.int64).T
        decoded = maps.image(k).isfinite().all(-1).numpy()
        found = decoded[row, column][(mask | decoded)[row, column]]
        shares.append(float(found.mean()) if len(found) >= s.fewest_judged else None)
    return SharedSurface(points, tuple(shares))


def _points(rig: Rig, maps: CoordinateMaps, settings: CrossFrameSettings) -> SurfacePoints:
    anchors = place_anchors(rig, maps, settings.pixels_of_each(rig.frames), torch.Generator().manual_seed(0))
    T = rig.T_world_camera[anchors.frame]
    p_world = transform(T, anchors.depth[:, None] * anchors.d_camera).numpy()
    return SurfacePoints(p_world, rotate(T, anchors.normal).numpy(), anchors.frame.numpy())
