"""From torch's parameters to the kernels' layout, and gradients back."""

import numpy as np
import torch
from torch import Tensor

from sl_nerfstudio.model.encoding import GridLayout
from sl_nerfstudio.model.field_backend import FieldState
from sl_nerfstudio.model.kernels.grid import FIRST, Grid
from sl_nerfstudio.model.kernels.mlp import Network, Weights
from sl_nerfstudio.model.kernels.simd import FEATURES


def pack_grid(layout: GridLayout, state: FieldState) -> Grid:
    """The grid; the table is shared, not copied."""
    return Grid(
        table=state.table.detach().numpy().reshape(-1),
        weights=state.level_weights.numpy(),
        resolutions=np.array(layout.resolutions, np.int64),
        offsets=np.array(layout.offsets, np.int64),
        sizes=np.array(layout.sizes, np.int64),
        hashed=np.array(layout.hashed, np.bool_),
        smooth=layout.smooth,
    )


def pack_network(layout: GridLayout, state: FieldState, knee: float) -> Network:
    """Copies of the MLP's weights, padded to multiples of 16, in both orders."""
    matrices, biases = [w.detach() for w in state.mlp[0::2]], [b.detach() for b in state.mlp[1::2]]
    width, layers = matrices[0].shape[0], len(matrices) - 1
    depth, hidden = _padded(FIRST + layout.width), _padded(width)
    first = torch.zeros(depth, hidden)
    first[:3, :width] = matrices[0][:, :3].T
    first[3, :width] = biases[0]
    first[FIRST : FIRST + layout.width, :width] = matrices[0][:, 3:].T
    middle = torch.zeros(layers - 1, hidden, hidden)
    bias = torch.zeros(layers - 1, hidden)
    for i in range(1, layers):
        middle[i - 1, :width, :width] = matrices[i].T
        bias[i - 1, :width] = biases[i]
    last = torch.zeros(hidden + 1)
    last[:width] = matrices[-1][0]
    last[hidden] = biases[-1][0]
    on = np.flatnonzero(state.level_weights.numpy())
    return Network(
        weights=Weights(*(t.numpy().reshape(-1) for t in (first, middle, bias, last))),
        first_transposed=first.T.contiguous().numpy().reshape(-1),
        middle_transposed=middle.mT.contiguous().numpy().reshape(-1),
        depth=depth,
        hidden=hidden,
        layers=layers,
        used=FIRST + FEATURES * (int(on[-1]) + 1 if len(on) else 0),
        knee=np.float32(knee),
    )


def zero_gradients(network: Network) -> Weights:
    """Gradients of the MLP, to be summed up."""
    return Weights(*(np.zeros_like(w) for w in network.weights))


def unpack_gradients(
    layout: GridLayout, state: FieldState, network: Network, parts: list[Weights]
) -> tuple[Tensor, ...]:
    """Sum of the MLP's gradients, in the shapes and the order of the parameters."""
    width, depth, hidden = state.mlp[0].shape[0], network.depth, network.hidden
    first, middle, bias, last = (torch.from_numpy(np.sum(part, axis=0)) for part in zip(*parts, strict=True))
    first = first.view(depth, hidden)[:, :width]
    middle = middle.view(-1, hidden, hidden)[:, :width, :width]
    bias = bias.view(-1, hidden)[:, :width]
    result = [torch.cat([first[:3], first[FIRST : FIRST + layout.width]]).T.contiguous(), first[3].clone()]
    for i in range(network.layers - 1):
        result += [middle[i].T.contiguous(), bias[i].clone()]
    return (*result, last[None, :width].clone(), last[hidden:].clone())


def _padded(n: int) -> int:
    return -(-n // 16) * 16
