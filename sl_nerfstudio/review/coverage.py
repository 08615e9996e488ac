"""What a frame has of the surface that other frames show: how much it decoded, and how much it should have seen.

Of the visible pattern, a part may lie on a table or a wall far behind the object, too fine or too blurred to be
decoded. That says nothing against the frame. What the others decoded does: it is there, and can be decoded.

Where both devices of a frame look at a surface, and nothing that any frame shows lies before it, the camera sees the
pattern. If it does not, this frame is at the wrong place, or those that show the surface are: faces of a box agree with
each other at many places, and nothing but their ends tells which is right.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray
from scipy.ndimage import distance_transform_edt

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.observations import place_anchors
from sl_nerfstudio.bundle_adjustment.residuals import Rig
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity, rotate, transform
from sl_nerfstudio.geometry.numerics import nearest_distances
from sl_nerfstudio.geometry.triangulation import world_pixels
from sl_nerfstudio.parallel import one_library_thread
from sl_nerfstudio.review.agreement import FEWEST_JUDGED, LEAST_COSINE, pixels_of_each
from sl_nerfstudio.scan.types import Scan

_MARGIN = 0.02  # share of the image's longer side: how far from all that a frame saw of the pattern it saw nothing, and
# how far inside the image and the pattern a point must lie
_LIT_COSINE = 0.35  # between a surface's normal and its rays to both devices, above which it would be lit and seen
_CELLS = 60  # places along the longer side of an image at which it is known what lies nearest to the device
_THICKNESS = 0.08  # share of the surface's radius: farther behind what is nearest, points count as hidden


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
    """Shares of the surface that others show in one frame; None where too little is known."""

    decoded: float | None  # see `shared_surface`
    missing: float | None  # see `missing_shares`


@dataclass(frozen=True)
class SharedSurface:
    """The surface that the frames of a scan show, and how much of the others' each of them decoded."""

    points: SurfacePoints
    decoded: tuple[float | None, ...]  # see `shared_surface`


def shared_surface_of_scan(scan: Scan) -> SharedSurface:
    """Compare the surfaces of a scan's frames: `shared_surface` with its files and its own poses."""
    return shared_surface(
        [f.camera for f in scan.frames],
        scan.projector,
        scan.poses,
        (f.read_coords() for f in scan.frames),
        (f.read_mask() for f in scan.frames),
    )


@one_library_thread()
def shared_surface(
    cameras: Sequence[Device],
    projector: Device,
    poses: DevicePoses,
    coords: Iterable[Float32[ndarray, "_h _w 2"]],
    masks: Iterable[Bool[ndarray, "_h _w"]],
) -> SharedSurface:
    """The share that a frame decoded of the points of other frames that lie where it sees the pattern.

    `masks`: where each frame sees the pattern. None for a frame on which too few points lie.
    """
    maps = CoordinateMaps.of(torch.from_numpy(image) for image in coords)
    points = _points(Rig.of(cameras, projector, poses, Similarity.identity()), maps)
    shares: list[float | None] = []
    for k, mask in enumerate(masks):
        uv, inside = world_pixels(cameras[k], poses.T_world_camera[k], points.p_world)
        _, cosine = points.sights(poses.T_world_camera[k, :3, 3])
        column, row = uv[inside & (cosine > LEAST_COSINE) & (points.source != k)].astype(np.int64).T
        decoded = maps.image(k).isfinite().all(-1).numpy()
        found = decoded[row, column][(mask | decoded)[row, column]]
        shares.append(float(found.mean()) if len(found) >= FEWEST_JUDGED else None)
    return SharedSurface(points, tuple(shares))


def _points(rig: Rig, maps: CoordinateMaps) -> SurfacePoints:
    anchors = place_anchors(rig, maps, pixels_of_each(rig.frames), torch.Generator().manual_seed(0))
    T = rig.T_world_camera[anchors.frame]
    p_world = transform(T, anchors.depth[:, None] * anchors.d_camera).numpy()
    return SurfacePoints(p_world, rotate(T, anchors.normal).numpy(), anchors.frame.numpy())


@one_library_thread()
def missing_shares(
    cameras: Sequence[Device],
    projector: Device,
    poses: DevicePoses,
    points: SurfacePoints,
    seen: Iterable[Bool[ndarray, "_h _w"] | None],
) -> list[float | None]:
    """The share around which a frame saw nothing, of the points of other frames that both of its devices look at.

    `seen`: where each camera saw the pattern, None if that is not known. None for a frame of which it is not, or in
    whose sight too few points lie.
    """
    centre = np.median(points.p_world, axis=0)
    thickness = _THICKNESS * float(np.median(np.linalg.norm(points.p_world - centre, axis=1)))
    shares: list[float | None] = []
    for k, pattern_seen in enumerate(seen):
        if pattern_seen is None:
            shares.append(None)
            continue
        uv, visible = _in_sight(cameras[k], poses.T_world_camera[k], points, thickness)
        _, lit = _in_sight(projector, poses.T_world_projector[k], points, thickness)
        column, row = uv[visible & lit & (points.source != k)].astype(np.int64).T
        far = np.asarray(distance_transform_edt(~pattern_seen)) > _MARGIN * max(pattern_seen.shape)
        shares.append(float(far[row, column].mean()) if len(row) >= FEWEST_JUDGED else None)
    return shares


def _in_sight(
    device: Device, T_world_device: Float64[ndarray, "4 4"], points: SurfacePoints, thickness: float
) -> tuple[Float64[ndarray, "n 2"], Bool[ndarray, "n"]]:
    """Pixels of all points, and which of them face the device and are not hidden from it by others."""
    uv, inside = world_pixels(device, T_world_device, points.p_world)
    distance, cosine = points.sights(T_world_device[:3, 3])
    border = _MARGIN * max(device.w, device.h)
    inner = inside & (uv > border).all(1) & (uv < np.array([device.w, device.h]) - border).all(1)
    factor = _CELLS / max(device.w, device.h)
    column, row = (uv[inside] * factor).astype(np.int64).T
    shape = int(device.h * factor) + 1, int(device.w * factor) + 1
    nearest = nearest_distances((row, column), distance[inside], shape)
    open_to = np.zeros(len(uv), dtype=bool)
    open_to[inside] = distance[inside] < nearest[row, column] + thickness
    return uv, inner & (cosine > _LIT_COSINE) & open_to
