"""How much of the surface that other frames show did a frame decode?

Of the visible pattern, a part may lie on a table or a wall far behind the object, too fine or too blurred to be
decoded. That says nothing against the frame. What the others decoded does: it is there, and can be decoded.
"""

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float32
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


def decoded_shares_of_scan(scan: Scan, settings: CrossFrameSettings | None = None) -> list[float | None]:
    """The same as `decoded_shares`, with the files of a scan and its own poses."""
    return decoded_shares(
        [f.camera for f in scan.frames],
        scan.projector,
        scan.poses,
        (f.read_coords() for f in scan.frames),
        (f.read_mask() for f in scan.frames),
        settings,
    )


@one_library_thread()
def decoded_shares(
    cameras: Sequence[Device],
    projector: Device,
    poses: DevicePoses,
    coords: Iterable[Float32[ndarray, "_h _w 2"]],
    masks: Iterable[Bool[ndarray, "_h _w"]],
    settings: CrossFrameSettings | None = None,
) -> list[float | None]:
    """Of the points of other frames that lie where a frame sees the pattern, the share that it decoded.

    `masks`: where each frame sees the pattern. None for a frame on which too few points lie.
    """
    s = settings or CrossFrameSettings()
    maps = CoordinateMaps.of(torch.from_numpy(image) for image in coords)
    rig = Rig.of(cameras, projector, poses, Similarity.identity())
    anchors = place_anchors(rig, maps, s.pixels_of_each(rig.frames), torch.Generator().manual_seed(0))
    T = rig.T_world_camera[anchors.frame]
    p_world = transform(T, anchors.depth[:, None] * anchors.d_camera).numpy()
    normal, source = rotate(T, anchors.normal).numpy(), anchors.frame.numpy()
    shares: list[float | None] = []
    for k, mask in enumerate(masks):
        uv, inside = world_pixels(cameras[k], poses.T_world_camera[k], p_world)
        sight = poses.T_world_camera[k, :3, 3] - p_world
        facing = (sight * normal).sum(1) > s.least_cosine * np.linalg.norm(sight, axis=1)
        column, row = uv[inside & facing & (source != k)].astype(np.int64).T
        decoded = maps.image(k).isfinite().all(-1).numpy()
        found = decoded[row, column][(mask | decoded)[row, column]]
        shares.append(float(found.mean()) if len(found) >= s.fewest_judged else None)
    return shares
