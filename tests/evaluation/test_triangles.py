import numpy as np
import trimesh

from sl_nerfstudio.evaluation.mesh_index import IndexedMesh, nearest_on_triangle, neighbours, thin
from sl_nerfstudio.meshing.mesh import Mesh

from .shapes import blob


def test_nearest_point_is_the_best_of_many_on_the_triangle() -> None:
    rng = np.random.default_rng(0)
    a, b, c, p = rng.normal(size=(4, 300, 3))
    found = nearest_on_triangle(p, a, b, c)
    expected = trimesh.triangles.closest_point(np.stack([a, b, c], 1), p)
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_degenerate_triangles_are_edges_or_points() -> None:
    zero = np.zeros((1, 3))
    x = np.array([[2.0, 0, 0]])
    p = np.array([[1.0, 1.0, 0]])
    np.testing.assert_allclose(nearest_on_triangle(p, zero, x, x / 2), [[1, 0, 0]])
    np.testing.assert_allclose(nearest_on_triangle(p, zero, zero, zero), [[0, 0, 0]])


def test_neighbours_share_an_edge_and_come_back() -> None:
    mesh = blob(12)
    found = neighbours(mesh.faces)
    for k in range(3):
        edge = {tuple(sorted(pair)) for pair in zip(mesh.faces[:, k], mesh.faces[:, (k + 1) % 3], strict=True)}
        assert len(edge) > 0
        for face, other in enumerate(found[:, k]):
            shared = set(mesh.faces[face][[k, (k + 1) % 3]])
            assert other != face and shared <= set(mesh.faces[other])
    lone = neighbours(np.array([[0, 1, 2]]))
    np.testing.assert_array_equal(lone, [[0, 0, 0]])


def test_thin_is_ten_times_longer_than_high() -> None:
    corners = np.array([[[0, 0, 0], [10, 0, 0], [5, 0.9, 0]], [[0, 0, 0], [10, 0, 0], [5, 1.1, 0]]], dtype=float)
    np.testing.assert_array_equal(thin(corners), [True, False])


def test_points_on_the_long_thin_triangles_of_a_cylinder_have_distance_zero() -> None:
    """Open3D alone, in float32, is wrong here by up to the width of a triangle."""
    angle = np.linspace(0, 2 * np.pi, 500, endpoint=False)
    ring = 10 * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], 1)
    low, high = np.arange(500), np.arange(500) + 500
    after = np.roll(low, -1)
    faces = np.concatenate([np.stack([low, after, after + 500], 1), np.stack([low, after + 500, high], 1)])
    surface = IndexedMesh(Mesh(np.concatenate([ring, ring + [0, 0, 60.0]]), faces))
    points, normals = surface.sample(5000, 0)
    assert surface.distance(points).max() < 1e-12
    np.testing.assert_allclose(surface.distance(points + 0.02 * normals), 0.02, rtol=1e-3)
