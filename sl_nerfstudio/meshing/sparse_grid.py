"""A regular grid of cells of which only those near the surface are visited.

Cells and corners have integer positions (x, y, z) from 0. A block is a cube of `size` cells, named by its lower cell.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, Num
from torch import Tensor

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.progress import track

Field = Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n"]]
"""Signed distance, negative inside, of points; both in the units of the box."""

LEAF = 2  # cells along an edge of the smallest blocks
MAX_LEAVES = 30_000_000  # about 30 GB: if more are near the zero level, the field is not a surface


@dataclass(frozen=True)
class Grid:
    """A box cut into `cells` along x, y, z (each a multiple of LEAF), and how its field is evaluated."""

    field: Field
    lower: tuple[float, float, float]
    step: tuple[float, float, float]
    cells: tuple[int, int, int]
    device: torch.device
    chunk: int = 1 << 18

    def points(self, position: Num[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Points, in float64, of positions counted in cells."""
        lower = torch.tensor(self.lower, dtype=torch.float64, device=position.device)
        return lower + position.double() * torch.tensor(self.step, dtype=torch.float64, device=position.device)

    def values(self, position: Num[Tensor, "n 3"], stage: str) -> Float[Tensor, "n"]:
        """Field at positions counted in cells (whole or not), chunk by chunk.

        Raises UserError where the field is not a number.
        """
        out = torch.empty(len(position), dtype=torch.float32, device=self.device)
        with torch.no_grad():
            for start in track(range(0, len(position), self.chunk), f"surface: {stage}"):
                part = self.points(position[start : start + self.chunk]).float()
                out[start : start + len(part)] = self.field(part).reshape(-1)
        if not bool(torch.isfinite(out).all()):
            raise UserError(
                f"the field is not a number at {int((~torch.isfinite(out)).sum())} of {len(out)} points: "
                "its training diverged. Train again with a lower learning rate, or export an earlier checkpoint."
            )
        return out

    def corner_keys(self, corner: Int[Tensor, "*batch 3"]) -> Int[Tensor, "*batch"]:
        """One number for each corner of the grid."""
        nx, ny = self.cells[0] + 1, self.cells[1] + 1
        return corner[..., 0] + nx * (corner[..., 1] + ny * corner[..., 2])

    def corners(self, key: Int[Tensor, "n"]) -> Int[Tensor, "n 3"]:
        """Inverse of `corner_keys`."""
        nx, ny = self.cells[0] + 1, self.cells[1] + 1
        return torch.stack([key % nx, key // nx % ny, key // (nx * ny)], -1)


@dataclass(frozen=True)
class Leaves:
    """Blocks of LEAF^3 cells with the field at their corners; `at` points into `value` and `key`."""

    lower: Int[Tensor, "n 3"]  # lower cell of each block
    at: Int[Tensor, "n 27"]  # corners of a block: x fastest, then y, then z
    key: Int[Tensor, "c"]  # Grid.corner_keys, sorted
    value: Float[Tensor, "c"]


def _offsets(n: int, device: torch.device) -> Int[Tensor, "n3 3"]:
    """All (x, y, z) below n, x fastest."""
    i = torch.arange(n, device=device)
    z, y, x = torch.meshgrid(i, i, i, indexing="ij")
    return torch.stack([x, y, z], -1).reshape(-1, 3)


def slope_bound(grid: Grid, samples: int = 32) -> float:
    """Slope of the field between neighbours of a coarse lattice: its 99th percentile, at least 1.

    A distance has slope 1, a trained field almost. The bound scales the radius within which a block is kept.
    """
    extent = torch.tensor(grid.cells, device=grid.device)
    value = grid.values(_offsets(samples, grid.device) / (samples - 1) * extent, "slope").reshape((samples,) * 3)
    spacing = [s * c / (samples - 1) for s, c in zip(grid.step, grid.cells, strict=True)]
    slopes = torch.cat([value.diff(dim=2 - axis).abs().reshape(-1) / spacing[axis] for axis in range(3)])
    return max(1.0, float(torch.quantile(slopes, 0.99)))


def find_leaves(grid: Grid, safety: float) -> Int[Tensor, "n 3"]:
    """Lower cells of all leaf blocks that may hold the zero level.

    Starting from about 64 blocks along the longest side, a block is split into eight while the field at its centre is
    smaller than `safety * slope_bound` times half the block's diagonal. Raises UserError if that is nearly everywhere.
    """
    reach = safety * slope_bound(grid)
    size = LEAF
    while max(grid.cells) > 64 * size:
        size *= 2
    extent = torch.tensor(grid.cells, device=grid.device)
    counts = [-(-c // size) for c in grid.cells]
    block = _offsets(max(counts), grid.device) * size
    block = block[(block < extent).all(-1)]
    while True:
        centre = torch.minimum(block + size / 2, extent)
        half_diagonal = 0.5 * size * sum(s * s for s in grid.step) ** 0.5
        block = block[grid.values(centre, f"blocks of {size} cells").abs() <= reach * half_diagonal]
        if size == LEAF:
            return block
        if len(block) * 8 > MAX_LEAVES * 2:
            raise UserError(
                f"the zero level passes through {len(block)} blocks of {size} cells: the field is not a surface yet. "
                "Train longer, or lower --resolution."
            )
        size //= 2
        block = (block[:, None] + _offsets(2, grid.device) * size).reshape(-1, 3)
        block = block[(block < extent).all(-1)]


def evaluate_leaves(grid: Grid, lower: Int[Tensor, "n 3"]) -> Leaves:
    """The field at the corners of leaf blocks, and of those that the surface enters from them.

    Where the field is not a distance the search may have missed a block; the surface then continues through a face of a
    known block. Such neighbours are added until none is missing, so a component is found completely if any part of it
    was found.
    """
    offsets = _offsets(LEAF + 1, grid.device)
    key = torch.empty(0, dtype=torch.long, device=grid.device)
    value = torch.empty(0, dtype=torch.float32, device=grid.device)
    while True:
        wanted, at = torch.unique(grid.corner_keys(lower[:, None] + offsets), return_inverse=True)
        fresh = wanted[~_contains(key, wanted)]
        key, value = torch.cat([key, fresh]), torch.cat([value, grid.values(grid.corners(fresh), "corners")])
        if len(fresh) < len(key):
            key, order = key.sort()
            value = value[order]
        leaves = Leaves(lower, at, key, value)
        missing = _entered_neighbours(grid, leaves)
        if len(missing) == 0:
            return leaves
        lower = torch.cat([lower, missing])


def _contains(sorted_keys: Tensor, wanted: Tensor) -> Tensor:
    if len(sorted_keys) == 0:
        return torch.zeros_like(wanted, dtype=torch.bool)
    index = torch.searchsorted(sorted_keys, wanted).clamp_max(len(sorted_keys) - 1)
    return sorted_keys[index] == wanted


def _entered_neighbours(grid: Grid, leaves: Leaves) -> Int[Tensor, "m 3"]:
    """Blocks not among `leaves` at whose common face with one of them the field changes its sign."""
    offsets = _offsets(LEAF + 1, grid.device)
    inside = leaves.value[leaves.at] < 0
    surface = inside.any(-1) & ~inside.all(-1)
    lower, inside = leaves.lower[surface], inside[surface]
    known = grid.corner_keys(leaves.lower).sort().values
    extent = torch.tensor(grid.cells, device=grid.device)
    found = []
    for axis in range(3):
        for side, step in ((0, -LEAF), (LEAF, LEAF)):
            face = inside[:, offsets[:, axis] == side]
            shift = torch.zeros(3, dtype=torch.long, device=grid.device)
            shift[axis] = step
            neighbour = (lower + shift)[face.any(-1) & ~face.all(-1)]
            neighbour = neighbour[((neighbour >= 0) & (neighbour < extent)).all(-1)]
            found.append(neighbour[~_contains(known, grid.corner_keys(neighbour))])
    return grid.corners(torch.unique(grid.corner_keys(torch.cat(found))))
