"""Holes, closed solids and fewer triangles, on surfaces whose truth is known by formula."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.distance import pdist

from sl_nerfstudio.meshing.extract import extract_mesh
from sl_nerfstudio.meshing.finish import MarkedMesh, closed_field, decimate, fill_holes
from sl_nerfstudio.meshing.mesh import Mesh, VertexProperties, VertexQuality
from sl_nerfstudio.meshing.visibility import Trimmed

from .solids import mesh_of, together

MESH = mesh_of(trimesh.creation.icosphere(4, 10.0))
CENTRE = MESH.vertices[MESH.faces].mean(1)
NORTH, EAST, SOUTH = np.array([0.0, 0, 10]), np.array([10.0, 0, 0]), np.array([0.0, 0, -10])


def trimmed_by(removed: np.ndarray, denied: np.ndarray | None = None, mesh: Mesh = MESH) -> Trimmed:
    """A mesh from which triangles were trimmed."""
    observed = mesh.corners_of(~removed)
    denied = np.zeros(len(observed), dtype=bool) if denied is None else denied
    return Trimmed(mesh.with_faces(~removed), ~removed, observed, denied, len(observed), 0, 0, 0, 0, 0.1)


def cap(pole: np.ndarray, radius: float) -> np.ndarray:
    return np.linalg.norm(CENTRE - pole, axis=1) < radius


def extent(removed: np.ndarray) -> float:
    """The largest distance between two points of what was removed."""
    return float(pdist(MESH.vertices[MESH.corners_of(removed)]).max())


def test_holes_up_to_the_size_are_closed_by_the_surface_itself_and_larger_ones_stay():
    small, large = cap(NORTH, 1.5), cap(EAST, 3.0)
    trimmed = trimmed_by(small | large)
    assert fill_holes(MESH, trimmed, 0.999 * extent(small)).closed == 0
    found = fill_holes(MESH, trimmed, 1.001 * extent(small))
    assert (found.closed, found.too_large, found.denied) == (1, 1, 0)
    assert np.array_equal(found.kept, ~large)
    assert found.area == pytest.approx(MESH.face_areas()[small].sum())
    assert fill_holes(MESH, trimmed, 0.999 * extent(large)).closed == 1
    both = fill_holes(MESH, trimmed, 1.001 * extent(large))
    assert both.closed == 2 and both.kept.all() and MESH.with_faces(both.kept).is_closed()
    inside = MESH.corners_of(small | large) & ~MESH.corners_of(~(small | large))
    marked = MarkedMesh(MESH, ~trimmed.observed).with_faces(both.kept)
    assert np.array_equal(marked.invented, inside)
    touched = MESH.face_areas()[inside[MESH.faces].any(1)].sum()
    assert marked.invented_share() == pytest.approx(touched / MESH.face_areas().sum())


def test_a_hole_that_frames_look_through_stays_open():
    removed = cap(NORTH, 2.0) | cap(SOUTH, 2.0)
    through = MESH.corners_of(cap(NORTH, 2.0))
    found = fill_holes(MESH, trimmed_by(removed, through), 6.0)
    assert (found.closed, found.denied) == (1, 1) and np.array_equal(found.kept, ~cap(NORTH, 2.0))


def test_what_has_an_end_of_its_own_is_no_hole():
    """The zero level leaves the box there: it closes nothing."""
    cut = MESH.with_faces(CENTRE[:, 2] < 8)
    kept = cut.vertices[cut.faces].mean(1)[:, 2] < 5
    found = fill_holes(cut, trimmed_by(~kept, mesh=cut), 100.0)
    assert (found.closed, found.too_large) == (0, 0) and np.array_equal(found.kept, kept)


def test_pieces_that_touch_in_one_vertex_are_two_holes():
    around = np.flatnonzero((MESH.faces == 0).any(1))
    removed = np.zeros(len(MESH.faces), dtype=bool)
    first = around[0]
    opposite = next(f for f in around if len(set(MESH.faces[f]) & set(MESH.faces[first])) == 1)
    removed[[first, opposite]] = True
    assert fill_holes(MESH, trimmed_by(removed), 2.0).closed == 2


def torus(p: torch.Tensor) -> torch.Tensor:
    return torch.stack([p[:, :2].norm(dim=1) - 0.6, p[:, 2]], 1).norm(dim=1) - 0.2


def test_decimation_keeps_the_surface_closed_and_states_how_far_it_moved():
    before = extract_mesh(torus, 64)
    found = decimate(before, 1500)
    after = found.mesh
    assert before.is_closed() and after.is_closed() and len(after.faces) <= 1500
    assert found.triangles_before == len(before.faces)
    vertices = trimesh.Trimesh(after.vertices, after.faces, process=False)
    _, back, _ = trimesh.proximity.closest_point(vertices, before.vertices[::10])
    assert np.sqrt((back**2).mean()) == pytest.approx(found.rms_error, rel=0.1)
    assert back.max() <= found.largest_error < 0.02
    _, away, _ = trimesh.proximity.closest_point(trimesh.Trimesh(before.vertices, before.faces), after.vertices[::10])
    np.testing.assert_allclose(found.distance[::10], away, atol=1e-5)
    near = np.linalg.norm(before.vertices[found.nearest] - after.vertices, axis=1)
    assert near.max() < 2 * before.edge_length()
    small = decimate(MESH, 10**6)
    assert small.mesh is MESH and np.array_equal(small.nearest, np.arange(len(MESH.vertices)))


def test_properties_go_to_the_nearest_vertex_and_a_move_adds_to_the_uncertainty():
    n = np.arange(4)
    sigma = np.array([3.0, np.nan, 1.0, 2.0])
    quality = VertexQuality(sigma, sigma / 2, n * 2, n * 0.1, n * 10.0)
    colour = np.stack([n, n, n], 1).astype(np.uint8)
    found = VertexProperties(quality, n == 1, colour).chosen(np.array([0, 1, 3])).moved(np.array([4.0, 1.0, 0.0]))
    np.testing.assert_allclose(found.quality.sigma, [5.0, np.nan, 2.0])
    np.testing.assert_allclose(found.quality.sigma_independent, [np.hypot(1.5, 4.0), np.nan, 1.0])
    assert found.quality.views.tolist() == [0, 2, 6] and found.invented.tolist() == [False, True, False]
    assert found.colour is not None and found.colour[:, 0].tolist() == [0, 1, 3]


def test_a_field_that_leaves_the_box_becomes_a_closed_solid_cut_flat_at_walls_and_planes():
    """A cylinder along z through the whole box, cut at z > -0.25 as well."""

    def cylinder(p: torch.Tensor) -> torch.Tensor:
        return p[:, :2].norm(dim=1) - 0.5

    assert not extract_mesh(cylinder, 48).is_closed()
    field = closed_field(cylinder, [(np.array([0.0, 0, 1]), -0.25)], torch.device("cpu"))
    solid = extract_mesh(field, 48)
    assert solid.is_closed() and solid.vertices[:, 2].min() == pytest.approx(-0.25, abs=1e-3)
    assert solid.vertices[:, 2].max() == pytest.approx(0.998, abs=2e-3)
    volume = trimesh.Trimesh(solid.vertices, solid.faces).volume
    assert volume == pytest.approx(np.pi * 0.25 * 1.248, rel=0.01)


def test_the_largest_component_is_the_one_with_the_largest_area():
    fine, coarse = (mesh_of(trimesh.creation.icosphere(*size)) for size in ((3, 1.0), (1, 5.0)))
    both = together(Mesh(fine.vertices + [20, 0, 0], fine.faces), coarse)
    found = MarkedMesh(both, np.arange(len(both.vertices)) >= len(fine.vertices)).largest_component()
    assert len(found.mesh.faces) == len(coarse.faces) and found.invented.all()
    np.testing.assert_allclose(np.linalg.norm(found.mesh.vertices, axis=1), 5.0)


def test_closed_means_two_triangles_at_every_edge_in_opposite_directions():
    assert MESH.is_closed() and not MESH.with_faces(np.arange(len(MESH.faces)) > 0).is_closed()
    turned = replace(MESH, faces=np.concatenate([MESH.faces[:1, ::-1], MESH.faces[1:]]))
    assert not turned.is_closed()
