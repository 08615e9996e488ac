"""Surfaces of analytic fields: closed, outward, on the zero level, at any resolution; and the table of cases."""

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import KDTree
from skimage.measure import marching_cubes

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.meshing import extract
from sl_nerfstudio.meshing.extract import extract_mesh
from sl_nerfstudio.meshing.mesh import Mesh

from .solids import triangles_at_edges


def sphere(p):
    return p.norm(dim=-1) - 0.5


def torus(p):
    return torch.stack([p[:, :2].norm(dim=-1) - 0.55, p[:, 2]], -1).norm(dim=-1) - 0.2


def box(p):
    q = p.abs() - p.new_tensor([0.5, 0.25, 0.375])
    return q.clamp_min(0).norm(dim=-1) + q.amax(-1).clamp_max(0)


def solid(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


@pytest.mark.parametrize("resolution", [17, 64, 150])
@pytest.mark.parametrize(
    ("sdf", "euler", "volume"), [(sphere, 2, np.pi / 6), (torus, 0, 2 * np.pi**2 * 0.55 * 0.04), (box, 2, 0.375)]
)
def test_closed_analytic_surfaces(sdf, euler, volume, resolution):
    mesh = extract_mesh(sdf, resolution)
    h = 2 / resolution
    closed = solid(mesh)
    assert closed.is_watertight and closed.is_winding_consistent
    assert closed.euler_number == euler
    # Smooth: second order, beyond the 1e-3 of a cell that vertices keep from corners. A kink in a cell: first order.
    assert sdf(torch.from_numpy(mesh.vertices)).abs().max() < (0.3 * h if sdf is box else 0.25 * h * h + 1.1e-3 * h)
    assert closed.volume == pytest.approx(volume, rel=2 * h if sdf is box else 12 * h * h)  # outward: positive
    assert len(np.unique(mesh.faces)) == len(mesh.vertices)


@pytest.fixture
def unpolished(monkeypatch: pytest.MonkeyPatch) -> None:
    """Vertices stay where linear interpolation puts them."""
    monkeypatch.setattr(extract, "POLISH", 0)


def test_error_falls_with_the_square_of_the_cell(monkeypatch):
    def rms(resolution: int, polish: int) -> float:
        monkeypatch.setattr(extract, "POLISH", polish)
        mesh = extract_mesh(torus, resolution)
        middle = mesh.vertices[mesh.faces].mean(1)
        return float(torus(torch.from_numpy(middle)).square().mean().sqrt())

    assert 3.5 < rms(32, 1) / rms(64, 1) < 4.5
    assert rms(64, 1) < 0.9 * rms(64, 0)


@pytest.mark.usefixtures("unpolished")
def test_same_vertices_as_dense_marching_cubes():
    """Scikit-image on the full grid is an independent implementation; a smooth surface has no ambiguous cells."""

    def shifted(p):
        return torus(p - p.new_tensor([0.013, 0.007, 0.011]))

    axis = torch.linspace(-1, 1, 41, dtype=torch.float64)
    dense = shifted(torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3).float())
    expected = marching_cubes(dense.reshape(41, 41, 41).numpy(), 0.0, spacing=(0.05,) * 3)[0] - 1
    ours = extract_mesh(shifted, 40).vertices
    assert len(ours) == len(expected)
    there, back = KDTree(expected).query(ours)[0], KDTree(ours).query(expected)[0]
    assert max(there.max(), back.max()) < 1e-4


@pytest.mark.usefixtures("unpolished")
@pytest.mark.parametrize("seed", range(3))
def test_noise_with_every_ambiguous_case_is_a_closed_surface(seed):
    """A lattice of random signs meets all 256 cases; no edge may have other than two triangles."""
    n = 24
    value = torch.rand((n + 1,) * 3, generator=torch.Generator().manual_seed(seed)) - 0.5
    for axis in range(3):
        value.index_fill_(axis, torch.tensor([0, n]), 0.3)

    def field(p):
        grid = p.reshape(1, 1, 1, -1, 3)  # grid_sample takes (x, y, z) for the last, middle and first axis
        return torch.nn.functional.grid_sample(value[None, None], grid, align_corners=True).reshape(-1)

    mesh = extract_mesh(field, n)
    assert set(triangles_at_edges(mesh)[1]) == {2}
    assert solid(mesh).is_winding_consistent and solid(mesh).volume > 0


@pytest.mark.usefixtures("unpolished")
@pytest.mark.parametrize("factor", [0.2, 30.0])
def test_a_field_that_is_no_distance_gives_the_same_surface(factor):
    """Flat or steep, and steep only near the surface, where the coarse look-out cannot know it."""
    steep, plain = extract_mesh(lambda p: factor * torus(p), 48), extract_mesh(torus, 48)
    late = extract_mesh(lambda p: torch.sign(torus(p)) * (torus(p).abs() * 50).clamp_max(0.5 + torus(p).abs()), 64)
    np.testing.assert_allclose(steep.vertices, plain.vertices, atol=1e-5)
    assert solid(late).is_watertight and solid(late).euler_number == 0


@pytest.mark.usefixtures("unpolished")
def test_surface_is_followed_out_of_the_blocks_that_were_found(monkeypatch):
    """Huge values everywhere except in one ball: only there is the surface found, the rest must be followed."""

    def field(p):
        near = (p - p.new_tensor([0.5, 0.0, 0.0])).norm(dim=-1) < 0.2
        return torch.where(near, sphere(p), sphere(p).sign() * 10)

    monkeypatch.setattr(extract, "SAFETY", 0.05)
    closed = solid(extract_mesh(field, 64))
    assert closed.is_watertight and closed.euler_number == 2


def test_a_surface_that_leaves_the_box_is_open_there_only():
    mesh = extract_mesh(lambda p: p[:, 2] - 0.1 * torch.sin(3 * p[:, 0]), 40)
    edges, count = triangles_at_edges(mesh)
    border = mesh.vertices[np.unique(edges[count == 1])]
    np.testing.assert_allclose(np.abs(border[:, :2]).max(1), 1.0)
    for axis, wall in ((0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0)):  # and all along each of the four walls
        along = np.sort(border[np.isclose(border[:, axis], wall), 1 - axis])
        np.testing.assert_allclose(along[[0, -1]], (-1, 1), atol=1e-9)
        assert np.diff(along).max() < 2 / 40 + 1e-9
    assert solid(mesh).euler_number == 1  # one sheet without holes


def test_only_points_near_the_surface_are_evaluated_in_bounded_chunks_of_float32():
    count = 0

    def counted(p):
        nonlocal count
        count += len(p)
        assert p.dtype == torch.float32 and p.abs().max() <= 1.0 and len(p) <= 1 << 18
        return sphere(p)[:, None]  # a column, as networks give it

    mesh = extract_mesh(counted, 255)
    assert count < 0.06 * 255**3 and count < 12 * len(mesh.vertices)


@pytest.mark.parametrize(
    ("field", "resolution", "message"),
    [
        (lambda p: torch.full_like(p[:, 0], 0.7), 32, r"no zero level.*positive everywhere.*last step.*sl-process"),
        (lambda p: torch.full_like(p[:, 0], -0.7), 32, r"no zero level.*negative everywhere"),
        (lambda p: torch.where(p[:, 0] > 0.5, torch.nan, sphere(p)), 32, r"not a number at \d+ of \d+.*diverged"),
        (lambda p: 1e-3 * torch.sin(500 * p).prod(-1), 256, r"is not a surface yet.*--resolution"),  # zero everywhere
        *((sphere, n, f"--resolution {n}: a mesh needs at least 2 cells") for n in (-3, 0, 1)),
    ],
)
def test_what_is_no_surface_is_refused_before_memory_runs_out(monkeypatch, field, resolution, message):
    monkeypatch.setattr(extract, "MAX_LEAVES", 100_000)
    with pytest.raises(UserError, match=message):
        extract_mesh(field, resolution)
