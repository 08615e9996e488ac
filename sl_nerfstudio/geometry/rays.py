"""Pixel centres, and the rays of pixels in the world."""

import torch
from jaxtyping import Float
from torch import Tensor

from sl_nerfstudio.geometry.devices import Device, Intrinsics, unproject
from sl_nerfstudio.geometry.se3 import rotate


def pixel_centres(device: Device, dtype: torch.dtype = torch.float32) -> Float[Tensor, "h w 2"]:
    """Coordinates (x, y) of all pixel centres of a device, starting with (0.5, 0.5)."""
    y, x = torch.meshgrid(
        torch.arange(device.h, dtype=dtype) + 0.5, torch.arange(device.w, dtype=dtype) + 0.5, indexing="ij"
    )
    return torch.stack([x, y], -1)


def pixel_rays(
    intrinsics: Intrinsics, T_world_device: Float[Tensor, "*#batch 4 4"], uv: Float[Tensor, "*#batch 2"]
) -> tuple[Float[Tensor, "*#batch 3"], Float[Tensor, "*#batch 3"]]:
    """Origin and unit direction, in the world, of the rays through pixels `uv`."""
    d_world = rotate(T_world_device, unproject(intrinsics, uv))
    return T_world_device[..., :3, 3].expand_as(d_world), d_world
