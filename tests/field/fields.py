"""Fields with large features, and a second implementation of the field's formula for torch's own derivatives."""

from typing import Any

import torch
from torch import Tensor

from sl_nerfstudio.field.field import KNEE, FieldConfig, SDFField
from sl_nerfstudio.field.torch_backend import encode, knee


def make_field(backend: str, dtype: torch.dtype = torch.float32, seed: int = 0, **options: Any) -> SDFField:
    """A small field whose features matter: two dense levels, two hashed ones."""
    torch.manual_seed(seed)
    config = FieldConfig(
        **{"levels": 4, "max_resolution": 128, "log2_table_size": 15, "hidden": 24, "backend": backend, **options}
    )
    field = SDFField(config)
    with torch.no_grad():
        field.encoding.table.uniform_(-0.1, 0.1)
        for layer in (*field.hidden, field.last):
            layer.bias.add_(0.01 * torch.randn_like(layer.bias))
    return field.to(dtype)


def plain_sdf(field: SDFField, p: Tensor) -> Tensor:
    """The field from differentiable torch operations only."""
    q = p.clamp(-1, 1)
    encoding = field.encoding
    h = torch.cat([q, encode(encoding.layout, encoding.table, encoding.level_weights, q)], -1)
    for layer in field.hidden:
        h = knee(layer(h), KNEE)
    square = ((p - q) ** 2).sum(-1)
    outside = square > 0
    return field.last(h)[:, 0] + torch.where(outside, torch.where(outside, square, 1.0).sqrt(), 0.0)


def points_around(n: int, seed: int = 1) -> Tensor:
    """Points inside and around the box, in float64, with values that float32 can represent."""
    generator = torch.Generator().manual_seed(seed)
    return (torch.rand(n, 3, generator=generator) * 2.6 - 1.3).double()


def relative(a: Tensor, b: Tensor) -> float:
    """Largest difference, relative to the largest value of `b`."""
    a, b = a.detach().double(), b.detach().double()
    return float((a - b).abs().max() / b.abs().max())
