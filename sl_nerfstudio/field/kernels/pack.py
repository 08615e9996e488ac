"""From torch's parameters to the kernels' layout, and gradients back."""

from functools import reduce

import numpy as np
import torch
from torch import Tensor

from sl_nerfstudio.field.backend import FieldState
from sl_nerfstudio.field.hash_grid import GridLayout
from sl_nerfstudio.field.kernels.grid import FIRST, Grid
from sl_nerfstudio.field.kernels.mlp import Network, Weights
from sl_nerfstudio.field.kernels.simd import FEATURES


def pack_grid(layout: GridLayout, state: FieldState) -> Grid:
    """The grid for the kernels; the table is shared, not copied."""
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
    matrices, biases = [w.detach().numpy() for w in state.mlp[0::2]], [b.detach().numpy() for b in state.mlp[1::2]]
    width, layers = matrices[0].shape[0], len(matrices) - 1
    depth, hidden = _padded(FIRST + layout.width), _padded(width)
    first = np.zeros((hidden, depth), np.float32)  # (output, input), as in torch
    first[:width, :3] = matrices[0][:, :3]
    first[:width, 3] = biases[0]
    first[:width, FIRST : FIRST + layout.width] = matrices[0][:, 3:]
    middle = np.zeros((layers - 1, hidden, hidden), np.float32)
    bias = np.zeros((layers - 1, hidden), np.float32)
    for i in range(1, layers):
        middle[i - 1, :width, :width] = matrices[i]
        bias[i - 1, :width] = biases[i]
    last = np.zeros(hidden + 1, np.float32)
    last[:width] = matrices[-1][0]
    last[hidden] = biases[-1][0]
    on = np.flatnonzero(state.level_weights.numpy())
    return Network(
        weights=Weights(first.T.ravel(), middle.swapaxes(1, 2).ravel(), bias.ravel(), last),
        first_transposed=first.ravel(),
        middle_transposed=middle.ravel(),
        depth=depth,
        hidden=hidden,
        layers=layers,
        used=FIRST + FEATURES * (int(on[-1]) + 1 if len(on) else 0),
        knee=np.float32(knee),
    )


def zero_gradients(network: Network) -> Weights:
    """Gradients of the MLP, initially zero, for kernels to add to."""
    return Weights(*(np.zeros_like(w) for w in network.weights))


def unpack_gradients(
    layout: GridLayout, state: FieldState, network: Network, parts: list[Weights]
) -> tuple[Tensor, ...]:
    """Sum of the MLP's gradients, in the shapes and the order of the parameters."""
    width, depth, hidden = state.mlp[0].shape[0], network.depth, network.hidden
    sums = Weights(*(reduce(np.add, part) for part in zip(*parts, strict=True)))
    first = sums.first.reshape(depth, hidden)[:, :width].T
    middle = sums.middle.reshape(-1, hidden, hidden)[:, :width, :width].swapaxes(1, 2)
    bias = sums.bias.reshape(-1, hidden)[:, :width]
    result = [np.concatenate([first[:, :3], first[:, FIRST : FIRST + layout.width]], 1), first[:, 3]]
    for i in range(network.layers - 1):
        result += [middle[i], bias[i]]
    result += [sums.last[None, :width], sums.last[hidden:]]
    return tuple(torch.from_numpy(np.ascontiguousarray(x)) for x in result)


def _padded(n: int) -> int:
    return -(-n // 16) * 16
