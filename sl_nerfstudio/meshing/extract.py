"""The zero level of a signed distance field as a mesh, at a cost that grows with its area, not with the volume."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.meshing.marching_table import EDGE_CORNERS, triangle_table
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.sparse_grid import LEAF, Field, Grid, Leaves, evaluate_leaves, find_leaves

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
    grid = _grid(sdf, resolution, lower, upper, torch.device(device))
    leaves = evaluate_leaves(grid, find_leaves(grid, safety))
    corner, case = _surface_cells(leaves)
    if len(case) == 0:
        raise UserError(_no_surface(grid))
    edges, faces = _triangles(corner, case)
    vertices = _vertices(grid, leaves, edges, polish)
    return Mesh(vertices.cpu().numpy(), faces.cpu().numpy())


def _grid(
    sdf: Field,
    resolution: int,
    lower: tuple[float, float, float],
    upper: tuple[float, float, float],
    device: torch.device,
) -> Grid:
    sides = [u - low for low, u in zip(lower, upper, strict=True)]
    if min(sides) <= 0:
        raise ValueError(f"the box is empty: lower {lower}, upper {upper}")
    cell = max(sides) / resolution
    cells = [LEAF * math.ceil(side / cell / LEAF - 1e-9) for side in sides]
    step = [side / n for side, n in zip(sides, cells, strict=True)]
    return Grid(sdf, lower, (step[0], step[1], step[2]), (cells[0], cells[1], cells[2]), device)


def _no_surface(grid: Grid) -> str:
    centre = torch.tensor([[c / 2 for c in grid.cells]], device=grid.device)
    sign = "positive" if float(grid.values(centre, "centre")[0]) > 0 else "negative"
    return (
        f"the field has no zero level in the box: it is {sign} everywhere, so there is no surface to export. "
        "The training has probably not begun to converge, or the scan's poses do not fit together: "
        "look at the run in ns-viewer, train longer, and check the scan with sl-check."
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


def _vertices(grid: Grid, leaves: Leaves, edges: Int[Tensor, "v 2"], polish: int) -> Float[Tensor, "v 3"]:
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
    """Where the line through (a, value_a) and (b, value_b), of opposite signs, is zero."""
    return a + (b - a) * value_a / (value_a - value_b)
