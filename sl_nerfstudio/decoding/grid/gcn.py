"""The graph network that recognises a node by the symbols around it.

Nodes of a capture and nodes of the pattern go through the same network. A node of the capture is the node of the
pattern, in one of its four quarter turns, with the most similar feature. So one set of weights serves every pattern,
and the geometry of camera and projector is not needed.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int8, Int32, Int64
from numpy import ndarray
from torch import Tensor, nn

from sl_nerfstudio.decoding.grid.graph import OFFSETS
from sl_nerfstudio.pattern.codes import SYMBOLS, rotate_codes

FEATURES = 160
_HIDDEN = 96


class GraphNetwork(nn.Module):
    """Two graph convolutions with one weight matrix for each place of a 5 x 5 neighbourhood.

    Walks along edges find the node at each place. Two rounds gather the symbols of up to 9 x 9 nodes.
    """

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Linear(len(OFFSETS) * (SYMBOLS + 1), _HIDDEN)
        self.second = nn.Linear(len(OFFSETS) * _HIDDEN, FEATURES)
        self.direct = nn.Linear(len(OFFSETS) * (SYMBOLS + 1), FEATURES)
        self.log_scale = nn.Parameter(torch.tensor(3.0))

    def forward(self, score: Float[Tensor, "n 5"], around: Int64[Tensor, "n 25"]) -> Float[Tensor, "n features"]:
        """Features of unit length; `around` is the graph's `neighbourhoods`."""
        present = torch.cat([score - 1 / SYMBOLS, torch.ones_like(score[:, :1])], 1)
        seen = _gather(present, around)
        hidden = torch.relu(self.first(seen))
        out = self.second(_gather(hidden, around)) + self.direct(seen)
        return nn.functional.normalize(out, dim=1)

    def logits(self, node: Float[Tensor, "n features"], candidate: Float[Tensor, "m features"]) -> Float[Tensor, "n m"]:
        """How similar each node is to each candidate."""
        return self.log_scale.exp() * node @ candidate.T


def _gather(values: Float[Tensor, "n c"], around: Int64[Tensor, "n 25"]) -> Float[Tensor, "n k"]:
    """Values of the nodes around each node; zero where there is none."""
    padded = torch.cat([values, values.new_zeros(1, values.shape[1])])
    return padded[around].flatten(1)  # -1 is the last row, which is zero


@dataclass(frozen=True)
class TurnedPattern:
    """All nodes of a pattern in its four quarter turns, one after the other."""

    symbol: Int8[ndarray, "m"]
    around: Int32[ndarray, "m 25"]
    turn: Int8[ndarray, "m"]  # clockwise quarter turns
    place: Int32[ndarray, "m 2"]  # (row, column) in the turned array


def turned_pattern(codes: Int8[ndarray, "rows columns"]) -> TurnedPattern:
    """The complete graphs of a code array and of its quarter turns."""
    symbols, arounds, turns, places = [], [], [], []
    first = 0
    for turn in range(4):
        turned = rotate_codes(codes, turn)
        rows, columns = turned.shape
        i, j = (part.reshape(-1) for part in np.mgrid[:rows, :columns])
        around = np.empty((len(i), len(OFFSETS)), dtype=np.int32)
        for k, (di, dj) in enumerate(OFFSETS):
            inside = (i + di >= 0) & (i + di < rows) & (j + dj >= 0) & (j + dj < columns)
            around[:, k] = np.where(inside, first + (i + di) * columns + j + dj, -1)
        symbols.append(turned.reshape(-1))
        arounds.append(around)
        turns.append(np.full(len(i), turn, dtype=np.int8))
        places.append(np.stack([i, j], -1).astype(np.int32))
        first += len(i)
    return TurnedPattern(*(np.concatenate(parts) for parts in (symbols, arounds, turns, places)))


def one_hot(symbol: Int8[ndarray, "m"]) -> Float[Tensor, "m 5"]:
    """Symbols that are certain, as scores."""
    return nn.functional.one_hot(torch.from_numpy(symbol.astype(np.int64)), SYMBOLS).float()
