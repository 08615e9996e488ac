"""How much of the surface that other frames show did a frame decode?

Of the visible pattern, a part may lie on a table or a wall far behind the object, too fine or too blurred to be
decoded. That says nothing against the frame. What the others decoded does: it is there, and can be decoded.
"""

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.observations import place_anchors
from sl_nerfstudio.bundle_adjustment.residuals import Anchors
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.devices import Device, project
from sl_nerfstudio.geometry.se3 import inverse, rotate, transform
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
    per_frame = max(s.least_pixels_per_frame, min(s.pixels_per_frame, s.most_pixels // rig.frames))
    anchors = place_anchors(rig, maps, per_frame, torch.Generator().manual_seed(0))
    T = rig.T_world_camera[anchors.frame]
    p_world, normal = transform(T, anchors.depth[:, None] * anchors.d_camera), rotate(T, anchors.normal)
    shares: list[float | None] = []
    for k, mask in enumerate(masks):
        decoded = maps.image(k).isfinite().all(-1).numpy()
        row, column = _pixels(rig, k, anchors, p_world, normal, s.least_cosine, decoded.shape)
        found = decoded[row, column][(mask | decoded)[row, column]]
        shares.append(float(found.mean()) if len(found) >= s.fewest_judged else None)
    return shares


def _pixels(
    rig: Rig,
    viewer: int,
    anchors: Anchors,
    p_world: Float[Tensor, "n 3"],
    normal_world: Float[Tensor, "n 3"],
    least_cosine: float,
    size: tuple[int, ...],
) -> tuple[ndarray, ndarray]:
    """Rows and columns of the points of other frames in an image of (height, width), of surface that faces it."""
    T = inverse(rig.T_world_camera[viewer])
    p, normal = transform(T, p_world), rotate(T, normal_world)
    facing = -(normal * p).sum(-1) > least_cosine * p.norm(dim=-1)
    uv, in_front = project(rig.camera[torch.full_like(anchors.frame, viewer)], p)
    pixel = uv.floor()
    inside = (pixel >= 0).all(-1) & (pixel < torch.tensor([size[1], size[0]])).all(-1)
    column, row = pixel[facing & in_front & inside & (anchors.frame != viewer)].long().numpy().T
    return np.asarray(row), np.asarray(column)
