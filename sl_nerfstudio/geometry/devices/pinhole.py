"""The pinhole model, "OPENCV": (x, y) = (x' / -z', -y' / -z') for a point p = (x', y', z') in device axes."""

import torch
from torch import Tensor

from sl_nerfstudio.geometry.devices.distortion import Number

_MIN_DEPTH = 1e-6  # of |p|; a point closer to the plane of the device counts as behind it


def normalised(x: Number, y: Number, z: Number) -> tuple[Number, Number]:
    """Normalised coordinates (y down) of a point in front; plain arithmetic, for tensors and compiled loops."""
    q = -1 / z
    return x * q, -y * q


def in_front(x: Number, y: Number, z: Number) -> bool | Tensor:
    """Whether a point has a pixel."""
    return -z > _MIN_DEPTH * (x * x + y * y + z * z) ** 0.5


def normalised_anywhere(p: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Normalised coordinates and `in_front`; finite, with finite gradients, for points behind as well."""
    x, y, z = p.unbind(-1)
    norm = (p * p).sum(-1).clamp_min(1e-30).sqrt()
    front = -z > _MIN_DEPTH * norm
    return *normalised(x, y, -torch.where(front, -z, norm.detach().clamp_min(1e-15))), front


def jacobian(p: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Normalised coordinates, and their derivatives [..., 3] with respect to the point."""
    x, y, z = p.unbind(-1)
    q = -1 / z
    xn, yn = x * q, -y * q
    o = torch.zeros_like(q)
    return xn, yn, torch.stack([q, o, xn * q], -1), torch.stack([o, -q, yn * q], -1)


def direction(x: Tensor, y: Tensor) -> Tensor:
    """Unit direction [..., 3], in device axes, of normalised coordinates."""
    d = torch.stack([x, -y, -torch.ones_like(x)], -1)
    return d / d.norm(dim=-1, keepdim=True)
