"""A few hundred correspondences of each frame, kept while the frames are read one by one."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.spacing import evenly_spaced

SAMPLES = 400  # per frame; enough for a median, few enough to try dozens of interpretations


@dataclass(frozen=True)
class Correspondences:
    """Camera pixels and pattern coordinates of one frame, with everything needed to triangulate them."""

    name: str
    camera: Device
    T_world_camera: Float64[ndarray, "4 4"]
    T_world_projector: Float64[ndarray, "4 4"]
    uv_camera: Float64[ndarray, "n 2"]
    uv_projector: Float64[ndarray, "n 2"]


def sample_pixels(
    coords: Float32[ndarray, "h w 2"], where: Bool[ndarray, "h w"]
) -> tuple[Float64[ndarray, "n 2"], Float64[ndarray, "n 2"]]:
    """Pixel centres and coordinates at SAMPLES pixels spread evenly over `where` (some twice if it has fewer)."""
    flat = np.flatnonzero(where)
    chosen = flat[evenly_spaced(len(flat), SAMPLES)]
    rows, columns = np.divmod(chosen, where.shape[1])
    return np.stack([columns, rows], -1) + 0.5, coords.reshape(-1, 2)[chosen].astype(np.float64)
