"""Pixel centres, the rays of pixels in the world, and the pixels of points in the world."""

import torch
from jaxtyping import Bool, Float, Float64
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project, unproject
from sl_nerfstudio.geometry.se3 import inverse, rotate, transform


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


def world_pixels(
    device: Device, T_world_device: Float[ndarray, "4 4"], p_world: Float[ndarray, "n 3"]
) -> tuple[Float64[ndarray, "n 2"], Bool[ndarray, "n"]]:
    """Pixels of points in the world, and whether each is in front of the device and inside its image."""
    T = inverse(torch.as_tensor(T_world_device, dtype=torch.float64))
    p_device = transform(T, torch.as_tensor(p_world, dtype=torch.float64))
    uv, in_front = project(Intrinsics.of(device, torch.float64), p_device)
    u, v = uv.numpy().T
    return uv.numpy(), in_front.numpy() & (u >= 0) & (v >= 0) & (u < device.w) & (v < device.h)
