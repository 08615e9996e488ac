"""The projector with a diffractive optical element, "DOE": (x, y) = (x' / |p|, -y' / |p|) for a point p = (x', y', z').

Its normalised coordinates are direction cosines, because those of the diffraction orders are evenly spaced (and their
tangents are not).
"""

import torch
from torch import Tensor

from sl_nerfstudio.geometry.devices.distortion import Number

_MIN_DEPTH = 1e-6  # of |p|; a point closer to the plane of the device counts as behind it


def normalised(x: Number, y: Number, z: Number) -> tuple[Number, Number]:
    """Normalised coordinates (y down) of a point in front; plain arithmetic, for tensors and compiled loops."""
    q = 1 / (x * x + y * y + z * z) ** 0.5
    return x * q, -y * q


def in_front(x: Number, y: Number, z: Number) -> bool | Tensor:
    """Whether a point has a pixel."""
    return -z > _MIN_DEPTH * (x * x + y * y + z * z) ** 0.5


def normalised_anywhere(p: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Normalised coordinates and `in_front`; finite, with finite gradients, for points behind as well."""
    x, y, z = p.unbind(-1)
    norm = (p * p).sum(-1).clamp_min(1e-30).sqrt()
    q = 1 / norm
    return x * q, -y * q, -z > _MIN_DEPTH * norm


def jacobian(p: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Normalised coordinates, and their derivatives [..., 3] with respect to the point."""
    x, y, z = p.unbind(-1)
    r = p.norm(dim=-1)
    q, q3 = 1 / r, 1 / r**3
    dx = torch.stack([q - x * x * q3, -x * y * q3, -x * z * q3], -1)
    dy = torch.stack([x * y * q3, y * y * q3 - q, y * z * q3], -1)
    return x * q, -y * q, dx, dy


def direction(x: Tensor, y: Tensor) -> Tensor:
    """Unit direction [..., 3], in device axes, of normalised coordinates; NaN beyond 90 degrees, where none exists."""
    return torch.stack([x, -y, -(1 - x * x - y * y).sqrt()], -1)
