"""Which points of a true surface a scan could observe."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from sl_nerfstudio.evaluation.indexed_mesh import IndexedMesh
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.rays import world_pixels


def observable(
    points: Float[ndarray, "m 3"],
    normals: Float[ndarray, "m 3"],
    surface: IndexedMesh,
    frames: Iterable[tuple[Device, Float[ndarray, "4 4"], Device, Float[ndarray, "4 4"]]],
) -> Bool[ndarray, "m"]:
    """Whether at least one frame's camera sees a point while that frame's projector lights it.

    Seen and lit mean: the surface faces the device, the point projects into its image, and no other part of the
    surface is in between. `frames` holds (camera, T_world_camera, projector, T_world_projector).
    """
    seen = np.zeros(len(points), bool)
    for camera, T_world_camera, projector, T_world_projector in frames:
        unseen = np.flatnonzero(~seen)
        for device, T in ((camera, T_world_camera), (projector, T_world_projector)):
            unseen = unseen[faces_and_falls_inside(points[unseen], normals[unseen], device, T)]
            unseen = unseen[~surface.occluded(points[unseen], T[:3, 3])]
        seen[unseen] = True
    return seen


def faces_and_falls_inside(
    points: Float[ndarray, "m 3"], normals: Float[ndarray, "m 3"], device: Device, T_world_device: Float[ndarray, "4 4"]
) -> Bool[ndarray, "m"]:
    """Whether points with outward `normals` face the device and project into its image."""
    _, inside = world_pixels(device, T_world_device, points)
    facing = ((T_world_device[:3, 3] - points) * normals).sum(1) > 0
    return inside & facing
