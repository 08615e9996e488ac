"""Multi-resolution feature grid: which table row each grid corner uses, and the module that owns the table.

Points are in [-1, 1]^3. A level of resolution R has (R + 1)^3 corners. Levels whose corners fit into
`2 ** log2_table_size` rows are indexed densely, finer ones are hashed (Müller et al., Instant Neural Graphics
Primitives, 2022). All levels share one flat table, so that the optimiser sees a single parameter.

All implementations follow the same rule at cell faces: `cell = clamp(floor(x), 0, R - 1)`.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn

# The interface of a field that rendering needs.


@runtime_checkable
class SignedDistance(Protocol):
    """A signed distance in scene units, negative inside; differentiable with respect to its parameters."""

    def sdf(self, p: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Signed distances of points; differentiable once with respect to `p`."""
        ...

    def sdf_and_gradient(self, p: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"]]:
        """Signed distances and their gradients by the point; `p` is a constant."""
        ...


FEATURES = 8  # numbers per table row: one vector of the compiled kernels
PRIMES = (1, 2654435761, 805459861)  # of the spatial hash; the first is 1, so neighbours along x share a cache line


@dataclass(frozen=True)
class GridLayout:
    """Where the levels of a feature grid are in the table."""

    resolutions: tuple[int, ...]  # cells per axis of each level
    offsets: tuple[int, ...]  # first row of each level in the table
    sizes: tuple[int, ...]  # rows of each level: at least as many as its corners, unless it is hashed
    hashed: tuple[bool, ...]  # whether rows are found by hashing (the size is then a power of two), not densely

    @staticmethod
    def build(levels: int, min_resolution: int, max_resolution: int, log2_table_size: int) -> "GridLayout":
        """Levels growing geometrically from `min_resolution` to `max_resolution`.

        Raises:
            ValueError: there is no level, or the resolutions are not increasing.
        """
        if levels < 1 or not 1 <= min_resolution <= max_resolution:
            raise ValueError(f"invalid grid: {levels} levels, {min_resolution}..{max_resolution}")
        growth = (max_resolution / min_resolution) ** (1 / max(levels - 1, 1))
        resolutions = tuple(round(min_resolution * growth**level) for level in range(levels))
        corners = [(r + 1) ** 3 for r in resolutions]
        sizes = tuple(min(-(-n // 8) * 8, 2**log2_table_size) for n in corners)  # whole cache lines
        offsets = tuple(sum(sizes[:level]) for level in range(levels))
        hashed = tuple(n > 2**log2_table_size for n in corners)
        return GridLayout(resolutions, offsets, sizes, hashed)

    @property
    def levels(self) -> int:
        """Number of levels."""
        return len(self.resolutions)

    @property
    def rows(self) -> int:
        """Rows of the whole table."""
        return sum(self.sizes)

    @property
    def width(self) -> int:
        """Length of an encoded point: levels times features."""
        return self.levels * FEATURES


class HashGrid(nn.Module):
    """The table of a feature grid and the weights that fade its levels in.

    `places` tells kernels for GPUs where the levels are: of each its resolution, its first row, and the bits that a
    hash keeps (0 if the level is not hashed).
    """

    level_weights: Tensor
    places: Tensor

    def __init__(self, layout: GridLayout):
        super().__init__()
        self.layout = layout
        self.table = nn.Parameter(torch.empty(layout.rows, FEATURES).uniform_(-1e-4, 1e-4))
        self.register_buffer("level_weights", torch.ones(layout.levels))
        kept = [size - 1 if hashed else 0 for size, hashed in zip(layout.sizes, layout.hashed, strict=True)]
        places = torch.tensor([layout.resolutions, layout.offsets, kept], dtype=torch.int32).T.contiguous()
        self.register_buffer("places", places, persistent=False)
        self._weights = (1.0,) * layout.levels
        self.register_load_state_dict_post_hook(_read_weights)

    @property
    def active(self) -> tuple[int, ...]:
        """Levels that are switched on; known to the host, which need not wait for a GPU."""
        return tuple(level for level, weight in enumerate(self._weights) if weight != 0)

    def set_level_weights(self, weights: Float[Tensor, "levels"]) -> None:
        """Fade levels: 0 switches a level off, 1 is its full strength.

        Raises:
            ValueError: the number of weights differs from the number of levels.
        """
        if weights.shape != self.level_weights.shape:
            raise ValueError(f"expected {self.layout.levels} level weights, got {tuple(weights.shape)}")
        values = tuple(weights.tolist())
        for level, (value, before) in enumerate(zip(values, self._weights, strict=True)):
            if value != before:
                self.level_weights[level].fill_(value)
        self._weights = values


def _read_weights(grid: HashGrid, _: object) -> None:
    """After a checkpoint was loaded."""
    grid._weights = tuple(grid.level_weights.tolist())
