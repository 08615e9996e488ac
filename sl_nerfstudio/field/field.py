"""The signed distance field: feature grid and small MLP, with an analytic gradient.

Inside the box [-1, 1]^3 the field is `f(p) = MLP(p, features(p))`. Outside it is continued by the distance to the
box: `f(p) = f(q) + |p - q|` with `q` the nearest point of the box.
"""

import itertools
import math
from dataclasses import dataclass
from typing import Literal

import torch
import tyro
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.field.backend import (
    BackendName,
    FieldBackend,
    FieldState,
    TableGradient,
    evaluated,
    numba_cannot,
    triton_cannot,
)
from sl_nerfstudio.field.hash_grid import GridLayout, HashGrid, SignedDistance
from sl_nerfstudio.field.torch_backend import TorchField, knee

# A coarse grid of the field's values: a very cheap way to find where a ray meets the surface.

_BAND_CELLS = 3.0  # vertices this close to the surface are kept up to date
_AT_ONCE = 131072


class CachedGrid(nn.Module):
    """Values of a field on a grid of [-1, 1]^3.

    Part of a checkpoint, so that a resumed run samples as an uninterrupted one would.
    """

    values: Tensor
    filled: Tensor

    def __init__(self, resolution: int = 96) -> None:
        super().__init__()
        self.resolution = resolution
        self.register_buffer("values", torch.zeros(resolution, resolution, resolution))
        self.register_buffer("filled", torch.tensor(False))
        self.is_filled = False  # the same, known to the host
        self.register_load_state_dict_post_hook(_read_filled)

    @property
    def cell(self) -> float:
        """Distance between neighbouring vertices."""
        return 2 / (self.resolution - 1)

    @torch.no_grad()
    def refresh(self, field: SignedDistance) -> None:
        """Evaluate the field again near its cached surface; the first time, and on a GPU, everywhere.

        A GPU does that in milliseconds, and would have to tell the host how many vertices are near.
        """
        flat = self.values.reshape(-1)
        if self.is_filled and flat.device.type == "cpu":
            index = (flat.abs() < _BAND_CELLS * self.cell).nonzero()[:, 0]
        else:
            index = torch.arange(len(flat), device=flat.device)
        n = self.resolution
        for part in index.split(_AT_ONCE):
            xyz = torch.stack([part % n, part // n % n, part // (n * n)], -1)
            flat[part] = field.sdf(xyz * self.cell - 1.0)
        self.filled.fill_(True)
        self.is_filled = True

    def look_up(self, p: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Trilinear values at points; outside the box, the value at the border."""
        grid = p.reshape(1, -1, 1, 1, 3)
        found = F.grid_sample(self.values[None, None], grid, padding_mode="border", align_corners=True)
        return found.reshape(-1)


def _read_filled(cache: CachedGrid, _: object) -> None:
    """After a checkpoint was loaded."""
    cache.is_filled = bool(cache.filled)


MIN_RESOLUTION = 16  # cells per axis of the grid's coarsest level
HIDDEN_LAYERS = 2  # of the MLP
KNEE = 0.02  # half-width of the rounded corner of the activation, a ReLU that is twice continuously differentiable
SPHERE_RADIUS = 0.5  # scene units: of the sphere that the field starts from


@dataclass
class FieldConfig:
    """Size of the field; the defaults are the paper's."""

    max_resolution: int = 256
    """Cells per axis of the grid's finest level; levels grow geometrically, by 2 with the default."""
    backend: BackendName = "auto"
    """numba: compiled for this CPU; triton: kernels for GPUs; torch: any device and precision; auto: numba on the CPU
    and triton on GPUs, wherever they work."""
    levels: tyro.conf.Suppress[int] = 5
    """Levels of the feature grid."""
    log2_table_size: tyro.conf.Suppress[int] = 19
    """Levels with more corners than 2 to this power share rows by hashing."""
    hidden: tyro.conf.Suppress[int] = 128
    """Width of the MLP's hidden layers."""


class SDFField(nn.Module):
    """Signed distance, in scene units, negative inside; points in [-1, 1]^3."""

    def __init__(self, config: FieldConfig):
        super().__init__()
        self.config = config
        layout = GridLayout.build(config.levels, MIN_RESOLUTION, config.max_resolution, config.log2_table_size)
        self.encoding = HashGrid(layout)
        widths = [3 + layout.width] + [config.hidden] * HIDDEN_LAYERS + [1]
        self.mlp = nn.ModuleList(nn.Linear(a, b) for a, b in itertools.pairwise(widths))
        self._backends: dict[str, FieldBackend] = {"torch": TorchField(layout, KNEE)}
        self._start_as_sphere(SPHERE_RADIUS)

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
            h = torch.cat([p, p.new_zeros(len(p), self.encoding.layout.width)], -1)
            for layer in self.hidden:
                h = knee(layer(h), KNEE)
            h = F.pad(h, (0, 1), value=1.0).double()
            wanted = p.double().norm(dim=-1) - radius
            normal = h.T @ h + 1e-3 * torch.eye(n + 1, dtype=torch.float64)
            start += torch.linalg.solve(normal, h.T @ (wanted - h @ start))
            self.last.weight.copy_(start[None, :n])
            self.last.bias.fill_(start[n].item())

    @property
    def hidden(self) -> list[nn.Linear]:
        """The MLP's hidden layers."""
        return [layer for layer in list(self.mlp)[:-1] if isinstance(layer, nn.Linear)]

    @property
    def last(self) -> nn.Linear:
        """The MLP's output layer."""
        layer = self.mlp[-1]
        assert isinstance(layer, nn.Linear)
        return layer

    def sdf(self, p: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Signed distance; differentiable (once) with respect to the parameters and `p`."""
        return self.sdf_and_last_gradients(p, len(p))[0]

    def forward_geonetwork(self, p: Float[Tensor, "n 3"]) -> Float[Tensor, "n 1"]:
        """`sdf` as a column, under the name that `ns-export marching-cubes` uses."""
        return self.sdf(p)[:, None]

    def sdf_and_gradient(self, p: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"]]:
        """Signed distance and its gradient, both differentiable with respect to the parameters; `p` is a constant."""
        return self.sdf_and_last_gradients(p.detach(), 0)

    def sdf_and_last_gradients(
        self, p: Float[Tensor, "n 3"], first: int
    ) -> tuple[Float[Tensor, "n"], Float[Tensor, "k 3"]]:
        """`sdf` at all points, and gradients at the k points from `first` on, which are constants.

        On a GPU this takes half the launches of `sdf` and `sdf_and_gradient`.
        """
        return evaluated(*self._parts(), p, first)

    def obstacle(self, backend: Literal["numba", "triton"]) -> str | None:
        """Why a compiled backend cannot serve the field where it is, or None if it can."""
        cannot = numba_cannot if backend == "numba" else triton_cannot
        return cannot(self.encoding.table)

    @property
    def backend(self) -> Literal["torch", "numba", "triton"]:
        """What serves the field where it is. Raises UserError if the one chosen by hand cannot."""
        name, device = self.config.backend, self.encoding.table.device.type
        if name == "auto":
            name = "numba" if device == "cpu" else "triton" if device == "cuda" else "torch"
        if name == "torch":
            return "torch"
        obstacle = self.obstacle(name)
        if obstacle is None:
            return name
        if self.config.backend == "auto":
            return "torch"
        raise UserError(f"{obstacle}; choose the backend auto or torch")

    def _parts(self) -> tuple[FieldBackend, TableGradient | None, FieldState]:
        """What evaluates the field, what it needs, and the table's persistent gradient buffer.

        There is a buffer if there will be a gradient, and compiled kernels write to it.
        """
        name, encoding = self.backend, self.encoding
        if name not in self._backends:
            self._backends[name] = _compiled(name, encoding.layout)
        buffer = TableGradient.of(encoding.table) if torch.is_grad_enabled() and name != "torch" else None
        mlp = tuple(parameter for layer in (*self.hidden, self.last) for parameter in (layer.weight, layer.bias))
        state = FieldState(encoding.table, encoding.level_weights, mlp, encoding.places, encoding.active)
        return self._backends[name], buffer, state


def _compiled(name: str, layout: GridLayout) -> FieldBackend:
    """A compiled backend; numba and Triton, which take a second to import, are imported only when needed."""
    if name == "numba":
        from sl_nerfstudio.field.numba_backend import NumbaField

        return NumbaField(layout, KNEE)
    from sl_nerfstudio.field.triton_backend import TritonField

    return TritonField(layout, KNEE)
