"""The length of a scale bar, measured by triangulation."""

import numpy as np
import torch
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.errors import Fault, ScanError
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.devices import Intrinsics
from sl_nerfstudio.geometry.rays import pixel_rays
from sl_nerfstudio.geometry.triangulation import triangulate
from sl_nerfstudio.scan.document import TRANSFORMS
from sl_nerfstudio.scan.types import PickedPixel, ScaleBar, Scan

NEAR_PX = 3.0  # how far from a picked pixel coordinates are used


def measured_length(scan: Scan, bar: ScaleBar, poses: DevicePoses) -> float:
    """Distance between the two picked surface points with these `poses` (of all frames), in the unit of the poses.

    Each point lies on the ray through its pixel, at the median depth of what was decoded within NEAR_PX of it.
    Reads the coordinates of the two frames. Raises ScanError where nothing near a pixel can be triangulated.
    """
    first, second = (_surface_point(scan, end, poses) for end in bar.ends)
    return float(np.linalg.norm(first - second))


def _surface_point(scan: Scan, end: PickedPixel, poses: DevicePoses) -> Float64[ndarray, "3"]:
    index = scan.index_of(end.frame)
    frame, coords = scan.frames[index], scan.frames[index].read_coords()
    row, column = np.nonzero(np.isfinite(coords).all(-1))
    uv = np.stack([column, row], 1) + 0.5
    near = np.linalg.norm(uv - end.pixel, axis=1) < NEAR_PX
    camera, projector = Intrinsics.of(frame.camera, torch.float64), Intrinsics.of(scan.projector, torch.float64)
    T_camera, T_projector = (
        torch.from_numpy(poses.T_world_camera[index]),
        torch.from_numpy(poses.T_world_projector[index]),
    )
    uv_projector = torch.from_numpy(coords[row[near], column[near]].astype(np.float64))
    points = triangulate(camera, T_camera, torch.from_numpy(uv[near]), projector, T_projector, uv_projector)
    depth = points.depth_camera.numpy()
    depth = depth[np.isfinite(depth)]
    if not len(depth):
        raise ScanError([_nothing_near(end)], str(scan.root))
    origin, direction = pixel_rays(camera, T_camera, torch.tensor([end.pixel], dtype=torch.float64))
    return (origin + float(np.median(depth)) * direction)[0].numpy()


def _nothing_near(end: PickedPixel) -> Fault:
    x, y = end.pixel
    return Fault(
        TRANSFORMS,
        end.frame,
        "scale.distance_between",
        f"has no decoded coordinates within {NEAR_PX:g} pixels of ({x:g}, {y:g})",
        "the pattern was not decoded there",
        "pick a pixel on the object where coordinates were decoded",
    )
