"""Rays of a frame's camera and projector through pixels that decoded the same point of the surface."""

import numpy as np
import torch
from jaxtyping import Float, Float64
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.geometry.devices import Intrinsics
from sl_nerfstudio.geometry.triangulation import triangulate
from sl_nerfstudio.scan import Scan

MOST_RAYS = 60
_FARTHEST = 3.0  # from the object's centre, scene units, whose radius is 0.8: rays that meet beyond are decoding errors


def pattern_rays(
    scan: Scan,
    frame: int,
    T_scene_camera: Float[Tensor, "4 4"],
    T_scene_projector: Float[Tensor, "4 4"],
) -> tuple[Float64[ndarray, "n 2 3"], Float64[ndarray, "n 2 3"]]:
    """Segments from the camera, and from the projector, to where the two rays meet; in the scene.

    At most `MOST_RAYS` of the decoded pixels, evenly over the image; none where nothing was decoded.
    """
    camera, projector = T_scene_camera.double().cpu(), T_scene_projector.double().cpu()
    coords = scan.frames[frame].read_coords()
    row, column = _evenly(np.isfinite(coords).all(-1))
    uv_camera = torch.from_numpy(np.stack([column, row], 1) + 0.5)
    uv_projector = torch.from_numpy(coords[row, column].astype(np.float64))
    met = triangulate(
        Intrinsics.of(scan.frames[frame].camera, torch.float64), camera, uv_camera,
        Intrinsics.of(scan.projector, torch.float64), projector, uv_projector,
    )  # fmt: skip
    p = met.p_world
    good = (met.depth_camera > 0) & (met.depth_projector > 0) & (p.norm(dim=-1) < _FARTHEST)
    ends = p[good].numpy()
    starts = (np.broadcast_to(T[:3, 3].numpy(), ends.shape) for T in (camera, projector))
    first, second = (np.stack([start, ends], 1) for start in starts)
    return first, second


def _evenly(decoded: ndarray) -> tuple[ndarray, ndarray]:
    """Rows and columns of some decoded pixels, on a square lattice that has at most `MOST_RAYS` of them."""
    step = max(1, int((decoded.sum() / MOST_RAYS) ** 0.5))
    while True:
        row, column = np.nonzero(decoded[step // 2 :: step, step // 2 :: step])
        if len(row) <= MOST_RAYS:
            return row * step + step // 2, column * step + step // 2
        step += 1
