"""How much of the surface that other frames show should a frame have seen, and saw nothing?

Where both of its devices look at a surface, and nothing that any frame shows lies before it, the camera sees the
pattern. If it does not, this frame is at the wrong place, or those that show the surface are: faces of a box agree with
each other at many places, and nothing but their ends tells which is right.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray
from scipy.ndimage import distance_transform_edt

from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.nearest_distances import nearest_distances
from sl_nerfstudio.geometry.rays import world_pixels
from sl_nerfstudio.threads import one_library_thread
from sl_nerfstudio.verdict.settings import MissingSurfaceSettings
from sl_nerfstudio.verdict.shared_surface import SurfacePoints


@one_library_thread()
def missing_shares(
    cameras: Sequence[Device],
    projector: Device,
    poses: DevicePoses,
    points: SurfacePoints,
    seen: Iterable[Bool[ndarray, "_h _w"] | None],
    settings: MissingSurfaceSettings | None = None,
) -> list[float | None]:
    """Of the points of other frames that both devices of a frame look at, the share around which it saw nothing.

    `seen`: where each camera saw the pattern, None if that is not known. None for a frame of which it is not, or in
    whose sight too few points lie.
    """
    s = settings or MissingSurfaceSettings()
    centre = np.median(points.p_world, axis=0)
    thickness = s.thickness * float(np.median(np.linalg.norm(points.p_world - centre, axis=1)))
    shares: list[float | None] = []
    for k, pattern_seen in enumerate(seen):
        if pattern_seen is None:
            shares.append(None)
            continue
        uv, visible = _in_sight(cameras[k], poses.T_world_camera[k], points, thickness, s)
        _, lit = _in_sight(projector, poses.T_world_projector[k], points, thickness, s)
        column, row = uv[visible & lit & (points.source != k)].astype(np.int64).T
        far = np.asarray(distance_transform_edt(~pattern_seen)) > s.margin * max(pattern_seen.shape)
        shares.append(float(far[row, column].mean()) if len(row) >= s.fewest_judged else None)
    return shares


def _in_sight(
    device: Device, T_world_device: Float64[ndarray, "4 4"], points: SurfacePoints, thickness: float,
    settings: MissingSurfaceSettings,
) -> tuple[Float64[ndarray, "n 2"], Bool[ndarray, "n"]]:  # fmt: skip
    """Pixels of all points, and which of them face the device and are not hidden from it by others."""
    uv, inside = world_pixels(device, T_world_device, points.p_world)
    distance, cosine = points.sights(T_world_device[:3, 3])
    border = settings.margin * max(device.w, device.h)
    inner = inside & (uv > border).all(1) & (uv < np.array([device.w, device.h]) - border).all(1)
    factor = settings.cells / max(device.w, device.h)
    column, row = (uv[inside] * factor).astype(np.int64).T
    shape = int(device.h * factor) + 1, int(device.w * factor) + 1
    nearest = nearest_distances((row, column), distance[inside], shape)
    open_to = np.zeros(len(uv), dtype=bool)
    open_to[inside] = distance[inside] < nearest[row, column] + thickness
    return uv, inner & (cosine > settings.least_cosine) & open_to
