import numpy as np
import pytest

from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.meshing.mesh import Mesh

from .shapes import blob, sphere


def square(z: float, half: float = 1.0) -> Mesh:
    corners = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))


@pytest.mark.parametrize("offset", [0.0, 1e5])
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_distance_is_to_the_triangles_not_to_their_corners_in_any_unit_and_anywhere(unit: float, offset: float) -> None:
    surface = IndexedMesh(Mesh(square(0.0).vertices * unit + offset * unit, square(0.0).faces))
    points = np.array([[0.1, 0.2, 0.3], [0.5, -0.4, -0.25], [2.0, 0.0, 0.0], [2.0, 2.0, 1.0]]) * unit + offset * unit
    expected = np.array([0.3, 0.25, 1.0, np.sqrt(3)]) * unit
    np.testing.assert_allclose(surface.distance(points), expected, rtol=1e-6)


def test_samples_are_spread_evenly_by_area_and_repeat_with_the_seed() -> None:
    small = square(0.0, 1.0)
    large = square(5.0, 3.0)  # nine times the area, the same number of triangles
    surface = IndexedMesh(
        Mesh(np.concatenate([small.vertices, large.vertices]), np.concatenate([small.faces, large.faces + 4]))
    )
    points, normals = surface.sample(20_000, seed=3)
    assert surface.area == pytest.approx(4 + 36)
    assert (points[:, 2] == 0).sum() == pytest.approx(2000, abs=2)  # stratified: exact up to a point at each end
    assert abs(points[points[:, 2] == 5][:, :2].mean()) < 0.05
    np.testing.assert_allclose(normals, np.broadcast_to([0, 0, 1], normals.shape))
    np.testing.assert_array_equal(points, surface.sample(20_000, seed=3)[0])
    assert not np.array_equal(points, surface.sample(20_000, seed=4)[0])


def test_rays_hit_the_plane_where_algebra_says() -> None:
    surface = IndexedMesh(square(0.0))
    rng = np.random.default_rng(0)
    origins = rng.uniform(-1, 1, (500, 3)) + [0, 0, 30.0]
    aims = np.concatenate([rng.uniform(-1.5, 1.5, (500, 2)), np.zeros((500, 1))], 1)
    length = np.linalg.norm(aims - origins, axis=1)
    hits = surface.cast(origins, (aims - origins) / length[:, None])
    np.testing.assert_array_equal(hits.hit, (np.abs(aims[:, :2]) < 1).all(1))
    np.testing.assert_allclose(hits.distance[hits.hit], length[hits.hit], rtol=1e-12)
    assert np.isnan(hits.distance[~hits.hit]).all() and (hits.face[~hits.hit] == -1).all()


def test_a_closed_shape_hides_exactly_its_far_side_from_a_distant_viewer() -> None:
    surface = IndexedMesh(sphere(resolution=80))
    points, normals = surface.sample(3000, seed=0)
    viewer = np.array([0.0, 0.0, 1000.0])
    away = ((viewer - points) * normals).sum(1) / np.linalg.norm(viewer - points, axis=1)
    clear = np.abs(away) > 0.08  # not on the rim, where facets and tolerance decide
    np.testing.assert_array_equal(surface.occluded(points, viewer)[clear], (away < 0)[clear])


def test_target_before_the_obstacle_is_not_hidden() -> None:
    surface = IndexedMesh(square(0.0))
    below = np.array([[0.0, 0.0, -1.0]])
    assert surface.occluded(below, np.array([0.0, 0.0, 2.0])).all()
    assert not surface.occluded(below, np.array([0.0, 0.0, -0.5])).any()


def test_closest_normal_is_the_triangles_own() -> None:
    surface = IndexedMesh(blob())
    points, normals = surface.sample(500, seed=1)
    near = surface.closest(points + 0.01 * normals)
    assert np.median(np.abs((near.normal * normals).sum(1) - 1)) < 1e-12
