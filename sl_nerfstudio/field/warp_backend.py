"""The field on a GPU: Warp kernels for the grid and the activations, torch's matrix products between them.

Values of all points and gradients of some of them are computed together, so that a training step needs few launches;
nothing waits for the GPU. Sums over points use atomic additions: their last digits differ from run to run.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from sl_nerfstudio.field import warp_kernels as grid_kernels
from sl_nerfstudio.field import warp_kernels as layer_kernels
from sl_nerfstudio.field.backend import FieldState, Kept, Pulled
from sl_nerfstudio.field.device_kernels import launch
from sl_nerfstudio.field.hash_grid import GridLayout
from sl_nerfstudio.field.warp_kernels import FEATURES, FIRST


@dataclass(frozen=True)
class _Kept(Kept):
    """Of n points, k of them with gradients; h is the width of a hidden layer, d that of an encoded point."""

    p: Float[Tensor, "n 3"]
    first: int
    packed: Float[Tensor, "h d"]
    z: list[Tensor]
    """Pre-activations [n, h] of the hidden layers."""
    a: list[Tensor]
    """Inputs of all layers: the encoded points, then activations [n, h]."""
    u: list[Tensor]
    """Derivatives of the field by the pre-activations [k, h]."""
    h: list[Tensor]
    """Its derivatives by the encoded points [k, d], then by the activations [k, h]; the last one [1, h] for all."""


class WarpField:
    """`MergedBackend` for float32 with 8 features per level, on a GPU or (slowly) on the CPU."""

    def __init__(self, layout: GridLayout, knee: float):
        self.layout = layout
        self.knee = knee
        self._smooth = 0  # linear interpolation

    def evaluate_all(self, state: FieldState, p: Float[Tensor, "n 3"], first: int) -> tuple[Tensor, Tensor, _Kept]:
        """See `MergedBackend`."""
        n, depth = len(p), FIRST + FEATURES * self.layout.levels
        weights, biases = _layers(state)
        hidden = weights[0].shape[0]
        packed, f = p.new_empty(hidden, depth), p.new_empty(n)
        launch(layer_kernels.pack_first, (hidden, depth), weights[0], biases[0], packed)
        a, z = [p.new_empty(n, depth)], []
        grid = (state.places, self._smooth, state.table, state.level_weights)
        launch(grid_kernels.encode, (self.layout.levels, n), *grid, p, biases[-1], a[0], f)
        for layer, weight in enumerate([packed, *weights[1:-1]]):
            z.append(torch.mm(a[-1], weight.T))
            a.append(torch.empty_like(z[-1]))
            bias = biases[layer] if layer else p.new_empty(0)  # the first layer's is in `packed`
            launch(layer_kernels.activate, (n, hidden), z[-1], bias, self.knee, a[-1])
        f.addmv_(a[-1], weights[-1][0])
        u, h = [], [weights[-1]]
        gradient = p.new_empty(n - first, 3)
        if first < n:
            for weight, z_layer in zip([*weights[-2:0:-1], packed], reversed(z), strict=True):
                u.insert(0, self._through(h[0], z_layer[first:]))
                h.insert(0, torch.mm(u[0], weight))
            launch(grid_kernels.to_points, n - first, *grid, p[first:], h[0], p.new_empty(0), n - first, gradient)
        return f, gradient, _Kept(p.detach(), first, packed, z, a, u, h)

    def pull_back_all(
        self,
        state: FieldState,
        kept: Kept,
        g: Float[Tensor, "n"],
        v: Float[Tensor, "k 3"],
        points: bool,
        parameters: bool,
        table_gradient: Float[Tensor, "rows f"] | None,
        marks: UInt8[Tensor, "marks"] | None,
    ) -> Pulled:
        """See `MergedBackend`."""
        assert isinstance(kept, _Kept)
        p, first, n = kept.p, kept.first, len(kept.p)
        weights, _ = _layers(state)
        grid = (state.places, self._smooth, state.table, state.level_weights)
        e_dot = torch.empty_like(kept.a[0][first:])
        along, z_dot = [e_dot], []
        if first < n:
            launch(grid_kernels.encode_along, (self.layout.levels, n - first), *grid, p[first:], v, e_dot)
            for weight, z in zip([kept.packed, *weights[1:-1]], kept.z, strict=True):
                z_dot.append(torch.mm(along[-1], weight.T))
                along.append(self._through(z_dot[-1], z[first:]))
        grads: list[Tensor] = []
        if parameters:
            top = kept.a[-1].T
            by_last = torch.addmv(along[-1].sum(0), top, g) if first < n else torch.mv(top, g)
            grads = [by_last[None], g.sum(0, keepdim=True)]
        none, empty = p.new_empty(0), p.new_empty(0, 0)
        d, upstream = weights[-1], g
        for layer in reversed(range(len(kept.z))):
            z, out = kept.z[layer], torch.empty_like(kept.z[layer])
            h, dot = (kept.h[layer + 1], z_dot[layer]) if first < n else (empty, empty)
            launch(layer_kernels.adjoint, tuple(z.shape), d, upstream, z, first, h, dot, self.knee, out)
            if parameters:
                gradient = torch.mm(out.T, kept.a[layer])
                if first < n:
                    gradient.addmm_(kept.u[layer].T, along[layer])
                grads = [*self._of_layer(layer, state, gradient, out), *grads]
            d, upstream = torch.mm(out, weights[layer] if layer else kept.packed), none
        if table_gradient is not None:
            u = kept.h[0] if first < n else empty
            marked = p.new_empty(0, dtype=torch.uint8) if marks is None else marks
            place = (state.places, self._smooth, state.level_weights)
            size = (self.layout.levels, n)
            launch(grid_kernels.scatter, size, *place, p, d, first, v, u, table_gradient, marked)
        dp = torch.empty_like(p) if points else None
        if dp is not None:
            launch(grid_kernels.to_points, n, *grid, p, d, g, first, dp)
        return Pulled(dp, tuple(grads) if parameters else None)

    def _through(self, x: Tensor, z: Tensor) -> Tensor:
        out = torch.empty_like(z)
        launch(layer_kernels.through, tuple(z.shape), x, z, self.knee, out)
        return out

    def _of_layer(self, layer: int, state: FieldState, gradient: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """Gradients of a hidden layer's weight and bias, in the parameters' own shapes."""
        if layer:
            return gradient, d.sum(0)
        weight, bias = torch.empty_like(state.mlp[0]), torch.empty_like(state.mlp[1])
        launch(layer_kernels.unpack_first, tuple(gradient.shape), gradient, weight, bias)
        return weight, bias


def _layers(state: FieldState) -> tuple[list[Tensor], list[Tensor]]:
    """Weights and biases, detached."""
    return [w.detach() for w in state.mlp[0::2]], [b.detach() for b in state.mlp[1::2]]
