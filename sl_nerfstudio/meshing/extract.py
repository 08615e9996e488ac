"""The zero level of a signed distance field as a mesh, at a cost that grows with its area, not with the volume."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import combinations

import numpy as np
import torch
from jaxtyping import Float, Int, Num
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.console import track
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.meshing.mesh import Mesh

# The 256 cases of marching cubes, derived by program, so that the surface is closed by construction.
#
# Corner `c` of a cell lies at `(c & 1, c >> 1 & 1, c >> 2 & 1)`. Bit `c` of a case is set where the field is
# negative there (inside). Edge `4 * axis + k` runs along `axis`; see EDGE_CORNERS.
#
# On every face of the cell the negative corners are separated: a diagonal pair gives two segments, each cutting off one
# negative corner. This depends only on the signs at that face, so the two cells at a face draw the same segments, and
# each edge that the surface cuts has exactly one segment on each of its faces: the segments form closed loops
# (Lorensen and Cline, SIGGRAPH 1987, with the face rule that makes their table free of holes).

AXIS_STEP = (1, 2, 4)  # what a step along x, y, z adds to a corner's number


EDGE_CORNERS = tuple((c, c + step) for step in AXIS_STEP for c in range(8) if not c & step)
"""Lower and upper corner of each of the 12 edges; edges 0 to 3 along x, 4 to 7 along y, 8 to 11 along z."""

_EDGE_OF_CORNERS = {frozenset(pair): edge for edge, pair in enumerate(EDGE_CORNERS)}


def _face_corners() -> list[tuple[int, int, int, int]]:
    """Corners of the six faces, counter-clockwise as seen from outside the cell."""
    faces = []
    for axis in range(3):
        u, v, w = AXIS_STEP[(axis + 1) % 3], AXIS_STEP[(axis + 2) % 3], AXIS_STEP[axis]
        faces.append((0, v, u + v, u))
        faces.append((w, w + u, w + u + v, w + v))
    return faces


FACE_CORNERS = _face_corners()
_FACE_EDGES = [{_EDGE_OF_CORNERS[frozenset((f[i], f[i - 1]))] for i in range(4)} for f in FACE_CORNERS]


def _loops(case: int) -> list[list[int]]:
    """Closed polygons of cut edges, counter-clockwise as seen from the positive side."""
    successor: dict[int, int] = {}
    for face in FACE_CORNERS:
        inside = [bool(case >> c & 1) for c in face]
        for i in range(4):
            if inside[i] and not inside[i - 1]:  # a sequence of negative corners begins here
                j = i
                while inside[(j + 1) % 4]:
                    j += 1
                enters = _EDGE_OF_CORNERS[frozenset((face[i - 1], face[i]))]
                leaves = _EDGE_OF_CORNERS[frozenset((face[j % 4], face[(j + 1) % 4]))]
                successor[enters] = leaves
    loops = []
    while successor:
        loop = [next(iter(successor))]
        while (following := successor.pop(loop[-1])) != loop[0]:
            loop.append(following)
        loops.append(loop)
    return loops


def _triangulate(loop: list[int]) -> list[tuple[int, int, int]] | None:
    """Triangles of a loop without a diagonal inside a face of the cell; None if there is no such choice.

    The neighbouring cell could draw the same diagonal inside a face: four triangles would meet in it.
    """
    if len(loop) == 3:
        return [(loop[0], loop[1], loop[2])]
    n = len(loop)
    for i, j in combinations(range(n), 2):
        if j - i in (1, n - 1) or any({loop[i], loop[j]} <= edges for edges in _FACE_EDGES):
            continue
        left, right = _triangulate(loop[i : j + 1]), _triangulate(loop[j:] + loop[: i + 1])
        if left is not None and right is not None:
            return left + right
    return None


@cache
def triangle_table() -> tuple[Int[ndarray, "256 t 3"], Int[ndarray, "256"]]:
    """Edges of the triangles of each case (-1 beyond the last) and how many triangles it has.

    Triangles are counter-clockwise as seen from the positive side, so normals point outward.
    Raises ValueError if a case has no such triangulation (tests show that all have one).
    """
    cases = []
    for case in range(256):
        triangles: list[tuple[int, int, int]] = []
        for loop in _loops(case):
            clean = _triangulate(loop)
            if clean is None:
                raise ValueError(f"case {case} has no triangulation without diagonals in faces")
            triangles += clean
        cases.append(triangles)
    table = np.full((256, max(map(len, cases)), 3), -1, dtype=np.int64)
    for case, triangles in enumerate(cases):
        if triangles:
            table[case, : len(triangles)] = triangles
    return table, np.array([len(triangles) for triangles in cases], dtype=np.int64)


# A regular grid of cells of which only those near the surface are visited.
#
# Cells and corners have integer positions (x, y, z) from 0. A block is a cube of `size` cells, named by its lower cell.

Field = Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n"]]
"""Signed distance, negative inside, of points; both in the units of the box."""

LEAF = 2  # cells along an edge of the smallest blocks
MAX_LEAVES = 30_000_000  # about 30 GB: if more are near the zero level, the field is not a surface


@dataclass(frozen=True)
class SparseGrid:
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
        """Number the corners of the grid."""
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


def slope_bound(grid: SparseGrid, samples: int = 32) -> float:
    """Slope of the field between neighbours of a coarse lattice: its 99th percentile, at least 1.

    A distance has slope 1, a trained field almost. The bound scales the radius within which a block is kept.
    """
    extent = torch.tensor(grid.cells, device=grid.device)
    value = grid.values(_offsets(samples, grid.device) / (samples - 1) * extent, "slope").reshape((samples,) * 3)
    spacing = [s * c / (samples - 1) for s, c in zip(grid.step, grid.cells, strict=True)]
    slopes = torch.cat([value.diff(dim=2 - axis).abs().reshape(-1) / spacing[axis] for axis in range(3)])
    return max(1.0, float(torch.quantile(slopes, 0.99)))


def find_leaves(grid: SparseGrid, safety: float) -> Int[Tensor, "n 3"]:
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


def evaluate_leaves(grid: SparseGrid, lower: Int[Tensor, "n 3"]) -> Leaves:
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


def _entered_neighbours(grid: SparseGrid, leaves: Leaves) -> Int[Tensor, "m 3"]:
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


_MARGIN = 1e-3  # of an edge: the smallest distance of a vertex from a corner, so that no triangle collapses


def extract_mesh(
    sdf: Field,
    resolution: int,
    lower: tuple[float, float, float] = (-1.0, -1.0, -1.0),
    upper: tuple[float, float, float] = (1.0, 1.0, 1.0),
    device: torch.device | str = "cpu",
    safety: float = 2.0,
    polish: int = 1,
) -> Mesh:
    """Mesh of the zero level of `sdf` in the box, with `resolution` cells along its longest side.

    `sdf` takes float32 points on `device`, at most 2^18 at a time, and gives the distance in the same units, negative
    inside; an approximate distance is enough (with a larger `safety` the surface is searched farther away). The mesh
    is in the box's frame, closed except where the surface leaves the box, and its normals point to positive values.
    `polish` regula falsi steps move each vertex along its grid edge to the field's own zero, beyond linear
    interpolation, for one more evaluation per vertex and step.
    Raises UserError if there is no surface in the box, or the field is not a number.
    """
    if resolution < 2:
        raise UserError(f"--resolution {resolution}: a mesh needs at least 2 cells along an axis; 256 or 512 is usual")
    sides = [u - low for low, u in zip(lower, upper, strict=True)]
    if min(sides) <= 0:
        raise ValueError(f"the box is empty: lower {lower}, upper {upper}")
    cell = max(sides) / resolution
    nx, ny, nz = (LEAF * math.ceil(side / cell / LEAF - 1e-9) for side in sides)
    step = (sides[0] / nx, sides[1] / ny, sides[2] / nz)
    grid = SparseGrid(sdf, lower, step, (nx, ny, nz), torch.device(device))
    leaves = evaluate_leaves(grid, find_leaves(grid, safety))
    corner, case = _surface_cells(leaves)
    if len(case) == 0:
        raise UserError(_no_surface(grid))
    edges, faces = _triangles(corner, case)
    vertices = _vertices(grid, leaves, edges, polish)
    return Mesh(vertices.cpu().numpy(), faces.cpu().numpy())


def _no_surface(grid: SparseGrid) -> str:
    centre = torch.tensor([[c / 2 for c in grid.cells]], device=grid.device)
    sign = "positive" if float(grid.values(centre, "centre")[0]) > 0 else "negative"
    return (
        f"the field has no zero level in the box: it is {sign} everywhere, so there is no surface to export. "
        "The training has probably not begun to converge, or the scan's poses do not fit together: "
        "train it to its last step; if that was done, find the poses anew with sl-process, from the photographs."
    )


def _surface_cells(leaves: Leaves) -> tuple[Int[Tensor, "m 8"], Int[Tensor, "m"]]:
    """Corners (as indices into `leaves.key`) and cases of the cells that the zero level passes through."""
    side = LEAF + 1
    cell = [x + side * (y + side * z) for z in range(LEAF) for y in range(LEAF) for x in range(LEAF)]
    corner = [(c & 1) + side * ((c >> 1 & 1) + side * (c >> 2 & 1)) for c in range(8)]
    device = leaves.at.device
    inside = leaves.value[leaves.at] < 0
    block = (inside.any(-1) & ~inside.all(-1)).nonzero()[:, 0]
    local = torch.tensor(cell, device=device)[:, None] + torch.tensor(corner, device=device)
    at = leaves.at[block][:, local].reshape(-1, 8)
    case = ((leaves.value[at] < 0) << torch.arange(8, device=device)).sum(-1)
    cut = (case > 0) & (case < 255)
    return at[cut], case[cut]


def _triangles(corner: Int[Tensor, "m 8"], case: Int[Tensor, "m"]) -> tuple[Int[Tensor, "v 2"], Int[Tensor, "f 3"]]:
    """Cut edges (as pairs of corners, lower first), each once, and triangles as triples of them."""
    table, count = (torch.from_numpy(t).to(case.device) for t in triangle_table())
    n = count[case]
    cell = torch.repeat_interleave(torch.arange(len(case), device=case.device), n)
    which = torch.arange(len(cell), device=case.device) - torch.repeat_interleave(n.cumsum(0) - n, n)
    edge = table[case[cell], which]
    ends = torch.tensor(EDGE_CORNERS, device=case.device)[edge]
    low = corner[cell[:, None], ends[..., 0]]
    axis = edge // 4
    key, faces = torch.unique(low * 3 + axis, return_inverse=True)
    high = torch.empty_like(key)
    high[faces] = corner[cell[:, None], ends[..., 1]]
    return torch.stack([key // 3, high], -1), faces


def _vertices(grid: SparseGrid, leaves: Leaves, edges: Int[Tensor, "v 2"], polish: int) -> Float[Tensor, "v 3"]:
    """Zeros of the field along the cut edges, in the box's frame, float64."""
    start, end = (grid.corners(leaves.key[edges[:, i]]).double() for i in range(2))
    direction = end - start
    a, b = torch.zeros_like(start[:, 0]), torch.ones_like(start[:, 0])
    value_a, value_b = (leaves.value[edges[:, i]].double() for i in range(2))
    t = _zero(a, b, value_a, value_b)
    for _ in range(polish):
        value = grid.values(start + t[:, None] * direction, "polish").double()
        below = (value < 0) == (value_a < 0)
        a, value_a = torch.where(below, t, a), torch.where(below, value, value_a)
        b, value_b = torch.where(below, b, t), torch.where(below, value_b, value)
        t = _zero(a, b, value_a, value_b)
    return grid.points(start + t.clamp(_MARGIN, 1 - _MARGIN)[:, None] * direction)


def _zero(a: Tensor, b: Tensor, value_a: Tensor, value_b: Tensor) -> Tensor:
    """Find where the line through (a, value_a) and (b, value_b), of opposite signs, is zero."""
    return a + (b - a) * value_a / (value_a - value_b)
