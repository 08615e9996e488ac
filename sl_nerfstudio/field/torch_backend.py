"""The field in plain torch with hand-written gradients: any device, any precision; the compiled version's reference.

Sizes in comments: n points, l levels, f features, c corners (8), h hidden width.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sl_nerfstudio.field.backend import FieldState, Pulled, SeparateBackend, Target
from sl_nerfstudio.field.hash_grid import FEATURES, PRIMES, GridLayout

# The feature grid in plain torch: the reference for tests of the fast versions, and the version that runs on GPUs.


def corner_rows(layout: GridLayout, level: int, cell: Int[Tensor, "n 3"]) -> Int[Tensor, "n 8"]:
    """Table rows of the eight corners of cells; x varies fastest."""
    corner = torch.arange(8, device=cell.device)
    offset = torch.stack([corner & 1, corner >> 1 & 1, corner >> 2 & 1], -1)
    x, y, z = (cell[:, None] + offset).unbind(-1)
    if layout.hashed[level]:
        row = (x * PRIMES[0] ^ y * PRIMES[1] ^ z * PRIMES[2]) & (layout.sizes[level] - 1)
    else:
        side = layout.resolutions[level] + 1
        row = x + side * (y + side * z)
    return row + layout.offsets[level]


def corner_weights(
    layout: GridLayout, level: int, p: Float[Tensor, "n 3"]
) -> tuple[Int[Tensor, "n 3"], Float[Tensor, "n 8"], Float[Tensor, "n 8 3"]]:
    """Cell of each point, the interpolation weights of its corners, and their derivatives with respect to `p`."""
    half = layout.resolutions[level] / 2
    x = (p + 1) * half
    cell = x.detach().nan_to_num(0).floor().clamp(0, layout.resolutions[level] - 1)
    t = x - cell
    slope = torch.full_like(t, half)
    pair = torch.stack([1 - t, t], -1)  # [n, axis, side]
    step = torch.stack([-slope, slope], -1)

    def product(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        return (z[:, :, None, None] * y[:, None, :, None] * x[:, None, None, :]).flatten(1)

    (px, py, pz), (sx, sy, sz) = pair.unbind(1), step.unbind(1)
    derivative = torch.stack([product(sx, py, pz), product(px, sy, pz), product(px, py, sz)], -1)
    return cell.long(), product(px, py, pz), derivative


def encode(
    layout: GridLayout, table: Float[Tensor, "rows f"], level_weights: Float[Tensor, "levels"], p: Float[Tensor, "n 3"]
) -> Float[Tensor, "n width"]:
    """Level-weighted features of points in [-1, 1]^3; differentiable (also twice) by torch itself."""
    features = []
    for level in range(layout.levels):
        cell, weight, _ = corner_weights(layout, level, p)
        rows = table[corner_rows(layout, level, cell)]
        features.append((weight[..., None] * rows).sum(1) * level_weights[level])
    return torch.cat(features, -1)


def knee(z: Float[Tensor, "*batch"], width: float) -> Float[Tensor, "*batch"]:
    """ReLU with a rounded corner of half-width `width`, which makes it twice continuously differentiable."""
    t = _place(z, width)
    return width * t**3 * (2 - t) + (z - width).clamp_min(0)


def _place(z: Tensor, width: float) -> Tensor:
    return (z / (2 * width) + 0.5).clamp(0, 1)


def _slope(z: Tensor, width: float) -> Tensor:
    """First derivative of `knee`."""
    t = _place(z, width)
    return t * t * (3 - 2 * t)


def _bend(z: Tensor, width: float) -> Tensor:
    """Second derivative of `knee`."""
    t = _place(z, width)
    return t * (1 - t) * (3 / width)


class TorchField(SeparateBackend):
    """The field in torch operations."""

    def __init__(self, layout: GridLayout, knee: float):
        self.layout = layout
        self.knee = knee

    def _encode(
        self, state: FieldState, p: Float[Tensor, "n 3"], jacobian: bool
    ) -> tuple[Float[Tensor, "n d"], Float[Tensor, "n d 3"] | None]:
        """MLP input, and its derivative with respect to `p`."""
        q = p.clamp(-1, 1)
        inside = (p == q).to(p.dtype)
        e = [q] + [p.new_zeros(len(p), FEATURES)] * self.layout.levels
        diagonal = torch.diag_embed(inside)
        jac = [diagonal] + [p.new_zeros(len(p), FEATURES, 3)] * self.layout.levels
        for level in state.active:
            cell, weight, slope = corner_weights(self.layout, level, q)
            rows = state.table.detach()[corner_rows(self.layout, level, cell)] * state.level_weights[level]
            e[1 + level] = torch.einsum("ncf,nc->nf", rows, weight)
            if jacobian:
                jac[1 + level] = torch.einsum("ncf,nca->nfa", rows, slope) * inside[:, None]
        return torch.cat(e, -1), torch.cat(jac, 1) if jacobian else None

    def _forward(self, state: FieldState, e: Float[Tensor, "n d"]) -> tuple[list[Tensor], list[Tensor]]:
        """Inputs of every layer and the hidden layers' pre-activations."""
        a, z = [e], []
        for w, b in zip(state.mlp[:-2:2], state.mlp[1:-2:2], strict=True):
            z.append(torch.addmm(b.detach(), a[-1], w.detach().T))
            a.append(knee(z[-1], self.knee))
        return a, z

    def _derivatives(self, state: FieldState, z: list[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
        """Derivatives of f by activations and by pre-activations; the last one is that of the MLP's input."""
        h = [state.mlp[-2].detach().expand(len(z[0]), -1)]
        u = []
        for w, z_layer in zip(state.mlp[-4::-2], reversed(z), strict=True):
            u.append(h[-1] * _slope(z_layer, self.knee))
            h.append(u[-1] @ w.detach())
        return h[::-1], u[::-1]

    def evaluate(
        self, state: FieldState, p: Float[Tensor, "n 3"], gradient: bool
    ) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"] | None]:
        """See `SeparateBackend`."""
        e, jac = self._encode(state, p, gradient)
        a, z = self._forward(state, e)
        distance, outward = _outside(p)
        f = torch.addmv(state.mlp[-1].detach().expand(len(p)), a[-1], state.mlp[-2].detach()[0]) + distance
        if jac is None:
            return f, None
        return f, torch.einsum("nda,nd->na", jac, self._derivatives(state, z)[0][0]) + outward

    def pull_back(
        self, state: FieldState, p: Float[Tensor, "n 3"], g: Float[Tensor, "n"], points: bool, to: Target
    ) -> Pulled:
        """See `SeparateBackend`."""
        e, jac = self._encode(state, p, points)
        a, z = self._forward(state, e)
        h, u = self._derivatives(state, z)
        dp = None
        if jac is not None:
            dp = g[:, None] * (torch.einsum("nda,nd->na", jac, h[0]) + _outside(p)[1])
        if not to.parameters:
            return Pulled(dp, None)
        d = [g[:, None] * x for x in u]
        if to.table is not None:
            self._scatter(state, p, g[:, None] * h[0], None, None, to.table)
        grads = [x for d_layer, before in zip(d, a, strict=False) for x in (d_layer.T @ before, d_layer.sum(0))]
        return Pulled(dp, (*grads, (g @ a[-1])[None], g.sum()[None]))

    def pull_back_gradient(
        self, state: FieldState, p: Float[Tensor, "n 3"], g: Float[Tensor, "n"], v: Float[Tensor, "n 3"], to: Target
    ) -> tuple[Tensor, ...]:
        """See `SeparateBackend`: one reverse sweep through the pair (f, derivative of f in the direction v)."""
        e, jac = self._encode(state, p, True)
        assert jac is not None
        a, z = self._forward(state, e)
        h, u = self._derivatives(state, z)
        a_dot, z_dot = [torch.einsum("nda,na->nd", jac, v)], []
        for w, z_layer in zip(state.mlp[:-2:2], z, strict=True):
            z_dot.append(a_dot[-1] @ w.detach().T)
            a_dot.append(z_dot[-1] * _slope(z_layer, self.knee))
        d = g[:, None] * state.mlp[-2].detach()
        grads = [(g @ a[-1] + a_dot[-1].sum(0))[None], g.sum()[None]]
        for layer in reversed(range(len(z))):
            bend = _bend(z[layer], self.knee) * z_dot[layer] * h[layer + 1]
            d = d * _slope(z[layer], self.knee) + bend
            grads = [d.T @ a[layer] + u[layer].T @ a_dot[layer], d.sum(0), *grads]
            d = d @ state.mlp[2 * layer].detach()
        if to.table is not None:
            self._scatter(state, p, d, h[0], v, to.table)
        return tuple(grads)

    def _scatter(
        self,
        state: FieldState,
        p: Float[Tensor, "n 3"],
        d: Float[Tensor, "n d"],
        slopes: Float[Tensor, "n d"] | None,
        v: Float[Tensor, "n 3"] | None,
        table_gradient: Float[Tensor, "rows f"],
    ) -> None:
        """Add adjoints `d` of the MLP's input to the table's gradient; `slopes` multiply the weights' derivatives."""
        q = p.clamp(-1, 1)
        for level in state.active:
            cell, weight, slope = corner_weights(self.layout, level, q)
            columns = slice(3 + level * FEATURES, 3 + (level + 1) * FEATURES)
            values = weight[..., None] * d[:, None, columns]
            if slopes is not None and v is not None:
                values = values + ((slope * (v * (p == q))[:, None]).sum(-1, keepdim=True) * slopes[:, None, columns])
            rows = corner_rows(self.layout, level, cell).flatten()
            table_gradient.index_add_(0, rows, (values * state.level_weights[level]).flatten(0, 1))


def _outside(p: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"]]:
    """Distance from the box [-1, 1]^3, and its gradient (zero inside)."""
    step = p - p.clamp(-1, 1)
    distance = step.norm(dim=-1)
    return distance, step / torch.where(distance == 0, 1, distance)[:, None]
