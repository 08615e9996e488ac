"""The signed distance field: feature grid and small MLP, with an analytic gradient.

Inside the box [-1, 1]^3 the field is `f(p) = MLP(p, features(p))`. Outside it is continued by the distance to the
box: `f(p) = f(q) + |p - q|` with `q` the nearest point of the box.
"""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from sl_nerfstudio.model.encoding import GridLayout, HashGrid
from sl_nerfstudio.model.encoding_torch import encode


@dataclass
class FieldConfig:
    """Size and start of the field; the defaults are the paper's sizes."""

    levels: int = 5
    """Levels of the feature grid."""
    min_resolution: int = 16
    """Cells per axis of the coarsest level."""
    max_resolution: int = 256
    """Cells per axis of the finest level; levels grow geometrically (by 2 with the defaults)."""
    features: int = 8
    """Numbers stored at each grid corner."""
    log2_table_size: int = 19
    """Levels with more corners than 2 to this power share rows by hashing."""
    smooth: bool = False
    """Smoothstep instead of linear interpolation: the gradient is then continuous across cells."""
    hidden: int = 128
    """Width of the MLP's hidden layers."""
    hidden_layers: int = 2
    """Number of the MLP's hidden layers."""
    softplus_beta: float = 100.0
    """Sharpness of the activation `log(1 + exp(beta x)) / beta`."""
    sphere_radius: float = 0.5
    """Radius, in scene units, of the sphere the field starts from."""
    backend: Literal["auto", "torch", "numba"] = "auto"
    """Implementation of the grid: numba on the CPU and torch on GPUs, or one of them by name."""


class SDFField(nn.Module):
    """Signed distance, in scene units, negative inside; points in [-1, 1]^3."""

    def __init__(self, config: FieldConfig):
        super().__init__()
        self.config = config
        self.encoding = HashGrid(
            GridLayout.build(
                config.levels,
                config.min_resolution,
                config.max_resolution,
                config.features,
                config.log2_table_size,
                config.smooth,
            )
        )
        widths = [3 + self.encoding.layout.width] + [config.hidden] * config.hidden_layers + [1]
        self.mlp = nn.ModuleList(nn.Linear(a, b) for a, b in zip(widths[:-1], widths[1:], strict=True))
        self._start_as_sphere(config.sphere_radius)

    def _start_as_sphere(self, radius: float) -> None:
        """Weights for which `f(p) ~ |p| - radius`: random hidden layers, last layer by ridge regression.

        The hidden layers are drawn as in SAL (Atzmon and Lipman, CVPR 2020), whose closed form for the last layer
        holds for infinite width; at width 128 it is wrong by up to 0.4, the regression by a few thousandths.
        """
        with torch.no_grad():
            for layer in self.hidden:
                layer.weight.normal_(0, math.sqrt(2 / layer.out_features))
                layer.bias.zero_()
            n = self.last.in_features
            start = torch.full((n + 1,), math.sqrt(math.pi / n), dtype=torch.float64)
            start[n] = -radius
            p = torch.rand(8192, 3) * 2 - 1
            h = self._hidden(torch.cat([p, p.new_zeros(len(p), self.encoding.layout.width)], -1))
            h = F.pad(h, (0, 1), value=1.0).double()
            wanted = p.double().norm(dim=-1) - radius
            normal = h.T @ h + 1e-3 * torch.eye(n + 1, dtype=torch.float64)
            start += torch.linalg.solve(normal, h.T @ (wanted - h @ start))
            self.last.weight.copy_(start[None, :n])
            self.last.bias.fill_(start[n].item())

    @property
    def hidden(self) -> list[nn.Linear]:
        """The MLP's hidden layers."""
        return [layer for layer in self.mlp[:-1] if isinstance(layer, nn.Linear)]

    @property
    def last(self) -> nn.Linear:
        """The MLP's output layer."""
        layer = self.mlp[-1]
        assert isinstance(layer, nn.Linear)
        return layer

    def _hidden(self, h: Float[Tensor, "n w"]) -> Float[Tensor, "n hidden"]:
        for layer in self.hidden:
            h = F.softplus(layer(h), beta=self.config.softplus_beta)
        return h

    def set_level_weights(self, weights: Float[Tensor, "levels"]) -> None:
        """Fade the grid's levels in, coarse to fine: one weight in [0, 1] a level."""
        self.encoding.set_level_weights(weights)

    def _inside(self, q: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        encoding = self.encoding
        h = torch.cat([q, encode(encoding.layout, encoding.table, encoding.level_weights, q)], -1)
        return self.last(self._hidden(h))[:, 0]

    def sdf(self, p: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Signed distance; differentiable with respect to the parameters and `p`."""
        q = p.clamp(-1, 1)
        return self._inside(q) + _safe_norm(p - q)

    def sdf_and_gradient(self, p: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"]]:
        """Signed distance and its gradient, both differentiable with respect to the parameters; `p` is a constant."""
        with torch.enable_grad():
            p = p.detach().requires_grad_()
            f = self.sdf(p)
            (g,) = torch.autograd.grad(f.sum(), p, create_graph=True)
        return f, g


def _safe_norm(v: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Euclidean length whose derivative at zero is zero."""
    square = (v * v).sum(-1)
    zero = square == 0
    return torch.where(zero, 0.0, torch.where(zero, 1.0, square).sqrt())
