"""The zero level of a signed distance field as a mesh, at a cost that grows with its area, not with the volume."""

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
"""Signed distance, negative inside, of points in [-1, 1]^3."""

LEAF = 2  # cells along an edge of the smallest blocks
MAX_LEAVES = 30_000_000  # about 30 GB: if more are near the zero level, the field is not a surface
SAFETY = 2.0  # times the bound of the slope: a field that is only roughly a distance is searched farther away
_CHUNK = 1 << 18  # points that are evaluated at a time
_COARSE = 32  # points along an axis, from which the slope is found


@dataclass(frozen=True)
class SparseGrid:
    """The cube [-1, 1]^3 cut into `cells` along each axis (a multiple of LEAF), and how its field is evaluated."""

    field: Field
    cells: int
    device: torch.device

    @property
    def step(self) -> float:
        """Side of a cell."""
        return 2.0 / self.cells

    def points(self, position: Num[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Points, in float64, of positions counted in cells."""
        return position.double() * self.step - 1.0

    def values(self, position: Num[Tensor, "n 3"], stage: str) -> Float[Tensor, "n"]:
        """Field at positions counted in cells (whole or not), chunk by chunk.

        Raises UserError where the field is not a number.
        """
        out = torch.empty(len(position), dtype=torch.float32, device=self.device)
        with torch.no_grad():
            for start in track(range(0, len(position), _CHUNK), f"surface: {stage}"):
                part = self.points(position[start : start + _CHUNK]).float()
                out[start : start + len(part)] = self.field(part).reshape(-1)
        if not bool(torch.isfinite(out).all()):
            raise UserError(
                f"the field is not a number at {int((~torch.isfinite(out)).sum())} of {len(out)} points: "
                "its training diverged. Train again with a lower learning rate, or export an earlier checkpoint."
            )
        return out

    def corner_keys(self, corner: Int[Tensor, "*batch 3"]) -> Int[Tensor, "*batch"]:
        """Number the corners of the grid."""
        n = self.cells + 1
        return corner[..., 0] + n * (corner[..., 1] + n * corner[..., 2])

    def corners(self, key: Int[Tensor, "n"]) -> Int[Tensor, "n 3"]:
        """Inverse of `corner_keys`."""
        n = self.cells + 1
        return torch.stack([key % n, key // n % n, key // (n * n)], -1)


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


def slope_bound(grid: SparseGrid) -> float:
    """Slope of the field between neighbours of a coarse lattice: its 99th percentile, at least 1.

    A distance has slope 1, a trained field almost. The bound scales the radius within which a block is kept.
    """
    value = grid.values(_offsets(_COARSE, grid.device) / (_COARSE - 1) * grid.cells, "slope").reshape((_COARSE,) * 3)
    spacing = grid.step * grid.cells / (_COARSE - 1)
    slopes = torch.cat([value.diff(dim=2 - axis).abs().reshape(-1) / spacing for axis in range(3)])
    return max(1.0, float(torch.quantile(slopes, 0.99)))


def find_leaves(grid: SparseGrid) -> Int[Tensor, "n 3"]:
    """Lower cells of all leaf blocks that may hold the zero level.

    Starting from about 64 blocks along each side, a block is split into eight while the field at its centre is smaller
    than `SAFETY * slope_bound` times half the block's diagonal. Raises UserError if that is nearly everywhere.
    """
    reach = SAFETY * slope_bound(grid)
    size = LEAF
    while grid.cells > 64 * size:
        size *= 2
    block = _offsets(-(-grid.cells // size), grid.device) * size
    while True:
        centre = (block + size / 2).clamp_max(grid.cells)
        half_diagonal = 0.5 * size * grid.step * 3**0.5
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
        block = block[(block < grid.cells).all(-1)]


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
    found = []
    for axis in range(3):
        for side, step in ((0, -LEAF), (LEAF, LEAF)):
            face = inside[:, offsets[:, axis] == side]
            shift = torch.zeros(3, dtype=torch.long, device=grid.device)
            shift[axis] = step
            neighbour = (lower + shift)[face.any(-1) & ~face.all(-1)]
            neighbour = neighbour[((neighbour >= 0) & (neighbour < grid.cells)).all(-1)]
            found.append(neighbour[~_contains(known, grid.corner_keys(neighbour))])
    return grid.corners(torch.unique(grid.corner_keys(torch.cat(found))))


_MARGIN = 1e-3  # of an edge: the smallest distance of a vertex from a corner, so that no triangle collapses
POLISH = 1  # steps of regula falsi that move vertices from linear interpolation to the field's own zero


def extract_mesh(sdf: Field, resolution: int, device: torch.device | str = "cpu") -> Mesh:
    """Mesh of the zero level of `sdf` in [-1, 1]^3, with `resolution` cells along each side.

    `sdf` takes float32 points on `device`, at most 2^18 at a time, and gives their distance, negative inside; an
    approximate one is enough. The mesh is closed except where the surface leaves the box, and its normals point to
    positive values. Raises UserError if there is no surface in the box, or the field is not a number.
    """
    if resolution < 2:
        raise UserError(f"--resolution {resolution}: a mesh needs at least 2 cells along an axis; 256 or 512 is usual")
    grid = SparseGrid(sdf, LEAF * -(-resolution // LEAF), torch.device(device))
    leaves = evaluate_leaves(grid, find_leaves(grid))
    corner, case = _surface_cells(leaves)
    if len(case) == 0:
        raise UserError(_no_surface(grid))
    edges, faces = _triangles(corner, case)
    vertices = _vertices(grid, leaves, edges)
    return Mesh(vertices.cpu().numpy(), faces.cpu().numpy())


def _no_surface(grid: SparseGrid) -> str:
    centre = torch.full((1, 3), grid.cells / 2, device=grid.device)
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


def _vertices(grid: SparseGrid, leaves: Leaves, edges: Int[Tensor, "v 2"]) -> Float[Tensor, "v 3"]:
    """Zeros of the field along the cut edges, in the box's frame, float64."""
    start, end = (grid.corners(leaves.key[edges[:, i]]).double() for i in range(2))
    direction = end - start
    a, b = torch.zeros_like(start[:, 0]), torch.ones_like(start[:, 0])
    value_a, value_b = (leaves.value[edges[:, i]].double() for i in range(2))
    t = _zero(a, b, value_a, value_b)
    for _ in range(POLISH):
        value = grid.values(start + t[:, None] * direction, "polish").double()
        below = (value < 0) == (value_a < 0)
        a, value_a = torch.where(below, t, a), torch.where(below, value, value_a)
        b, value_b = torch.where(below, b, t), torch.where(below, value_b, value)
        t = _zero(a, b, value_a, value_b)
    return grid.points(start + t.clamp(_MARGIN, 1 - _MARGIN)[:, None] * direction)


def _zero(a: Tensor, b: Tensor, value_a: Tensor, value_b: Tensor) -> Tensor:
    """Find where the line through (a, value_a) and (b, value_b), of opposite signs, is zero."""
    return a + (b - a) * value_a / (value_a - value_b)
