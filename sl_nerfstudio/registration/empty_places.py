"""Where a frame saw nothing of the pattern, although it would have fallen on a surface there.

A camera that looks into empty space says as much of an object as one that sees its surface. Two faces of a box agree
wherever one lies on the other; but where the larger one ends, the frame of the smaller one saw nothing.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray
from scipy.ndimage import distance_transform_edt

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.devices.models import for_loops
from sl_nerfstudio.geometry.nearest_distances import nearest_distances
from sl_nerfstudio.registration.frame_cloud import FrameCloud
from sl_nerfstudio.registration.settings import EmptyPlaceSettings
from sl_nerfstudio.relative_pose.ray_pairs import correspondences_of


@dataclass(frozen=True)
class EmptyPlaces:
    """Of one frame; lengths in units of its baseline."""

    empty: Bool[ndarray, "h w"]  # places of the surface map around which the camera saw nothing of the pattern
    projector: Device  # of the lattice of `reach`: the frame's projector, scaled
    T_projector_camera: Float64[ndarray, "4 4"]
    reach: Float64[ndarray, "a b"]  # how far from the projector a surface would be lit: up to what was seen; see below

    @cached_property
    def light(self) -> tuple[int, Float64[ndarray, "8"], Float64[ndarray, "4 4"], Float64[ndarray, "a b"]]:
        """The projector, its pose and `reach`, for compiled loops."""
        return *for_loops(self.projector), self.T_projector_camera, self.reach


def find_empty_places(cloud: FrameCloud, camera: Device, settings: EmptyPlaceSettings) -> EmptyPlaces:
    """Of a frame on the lattice of `camera`; none if it is not known where the frame saw the pattern.

    `reach` is infinite where the camera saw nothing of what the projector lit, and 0 beside the pattern: there, and
    behind what was seen, a surface may be dark.
    """
    T = np.linalg.inv(cloud.pose.T_camera_projector)
    factor = min(1.0, settings.projector_side / max(cloud.projector.w, cloud.projector.h))
    projector = cloud.projector.scaled(factor)
    if cloud.seen is None:
        nowhere = np.zeros((camera.h, camera.w), dtype=bool)
        return EmptyPlaces(nowhere, projector, T, np.zeros((projector.h, projector.w)))
    empty = _empty(cloud.seen, camera, settings.margin)
    return EmptyPlaces(empty, projector, T, _reach(cloud, projector, T, factor))


def _empty(pattern_seen: Bool[ndarray, "H W"], camera: Device, margin: float) -> Bool[ndarray, "h w"]:
    seen = np.zeros((camera.h, camera.w), dtype=bool)
    factor = max(camera.w, camera.h) / max(pattern_seen.shape)
    row, column = np.nonzero(pattern_seen)
    seen[_cell(row + 0.5, factor, camera.h), _cell(column + 0.5, factor, camera.w)] = True
    around = np.pad(seen, 1, constant_values=True)  # what is beside the image is not known
    return np.asarray(distance_transform_edt(~around))[1:-1, 1:-1] > margin * max(camera.w, camera.h)


def _reach(
    cloud: FrameCloud, projector: Device, T_projector_camera: Float64[ndarray, "4 4"], factor: float
) -> Float64[ndarray, "a b"]:
    uv = correspondences_of(cloud.coords)[1]
    distance = np.linalg.norm(cloud.points @ T_projector_camera[:3, :3].T + T_projector_camera[:3, 3], axis=1)
    cells = _cell(uv[:, 1], factor, projector.h), _cell(uv[:, 0], factor, projector.w)
    reach = nearest_distances(cells, distance, (projector.h, projector.w))
    reach[[0, -1]] = reach[:, [0, -1]] = 0.0
    return reach


def _cell(place: Float64[ndarray, "n"], factor: float, count: int) -> ndarray:
    return np.minimum(np.floor(place * factor).astype(np.int64), count - 1)
