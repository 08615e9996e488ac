"""Nearest points, ray hits, occlusion and samples of a mesh, and which of its points a scan could observe."""

import numpy as np
import pytest
import trimesh

from sl_nerfstudio.evaluation.mesh_index import CaptureView, IndexedMesh, nearest_on_triangle, observable
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.meshing.mesh import Mesh
from tests.meshing.solids import plate, together

from .faceted_scan import looking_at_origin
from .shapes import sphere

SQUARE = plate(1.0, 2.0)


@pytest.mark.parametrize("offset", [0.0, 1e5])
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_distance_is_to_the_triangles_not_to_their_corners_in_any_unit_and_anywhere(unit: float, offset: float) -> None:
    surface = IndexedMesh(Mesh((SQUARE.vertices + offset) * unit, SQUARE.faces))
    points = np.array([[0.1, 0.2, 0.3], [0.5, -0.4, -0.25], [2.0, 0.0, 0.0], [2.0, 2.0, 1.0]]) * unit + offset * unit
    expected = np.array([0.3, 0.25, 1.0, np.sqrt(3)]) * unit
    np.testing.assert_allclose(surface.distance(points), expected, rtol=1e-6)


def test_samples_are_spread_evenly_by_area_and_repeat_with_the_seed() -> None:
    surface = IndexedMesh(together(SQUARE, plate(3.0, 6.0, 5.0)))  # nine times the area, the same number of triangles
    points, normals = surface.sample(20_000, seed=3)
    assert surface.area == pytest.approx(4 + 36)
    assert (points[:, 2] == 0).sum() == pytest.approx(2000, abs=2)  # stratified: exact up to a point at each end
    assert abs(points[points[:, 2] == 5][:, :2].mean()) < 0.05
    np.testing.assert_allclose(normals, np.broadcast_to([0, 0, 1], normals.shape))
    np.testing.assert_array_equal(points, surface.sample(20_000, seed=3)[0])
    assert not np.array_equal(points, surface.sample(20_000, seed=4)[0])


def test_rays_hit_the_plane_where_algebra_says() -> None:
    surface = IndexedMesh(SQUARE)
    rng = np.random.default_rng(0)
    origins = rng.uniform(-1, 1, (500, 3)) + [0, 0, 30.0]
    aims = np.concatenate([rng.uniform(-1.5, 1.5, (500, 2)), np.zeros((500, 1))], 1)
    length = np.linalg.norm(aims - origins, axis=1)
    hits = surface.cast(origins, (aims - origins) / length[:, None])
    np.testing.assert_array_equal(hits.hit, (np.abs(aims[:, :2]) < 1).all(1))
    np.testing.assert_allclose(hits.distance[hits.hit], length[hits.hit], rtol=1e-12)
    assert np.isnan(hits.distance[~hits.hit]).all() and (hits.face[~hits.hit] == -1).all()


def test_a_shape_hides_exactly_its_far_side_and_nothing_before_it() -> None:
    surface = IndexedMesh(sphere(resolution=80))
    points, normals = surface.sample(3000, seed=0)
    viewer = np.array([0.0, 0.0, 1000.0])
    away = ((viewer - points) * normals).sum(1) / np.linalg.norm(viewer - points, axis=1)
    clear = np.abs(away) > 0.08  # not on the rim, where facets and tolerance decide
    np.testing.assert_array_equal(surface.occluded(points, viewer)[clear], (away < 0)[clear])
    below, plane = np.array([[0.0, 0.0, -1.0]]), IndexedMesh(SQUARE)
    assert plane.occluded(below, np.array([0.0, 0.0, 2.0])).all()
    assert not plane.occluded(below, np.array([0.0, 0.0, -0.5])).any()


def test_nearest_point_is_the_best_of_many_on_the_triangle() -> None:
    rng = np.random.default_rng(0)
    a, b, c, p = rng.normal(size=(4, 300, 3))
    found = nearest_on_triangle(p, a, b, c)
    expected = trimesh.triangles.closest_point(np.stack([a, b, c], 1), p)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    zero, x, above = np.zeros((1, 3)), np.array([[2.0, 0, 0]]), np.array([[1.0, 1.0, 0]])
    np.testing.assert_allclose(nearest_on_triangle(above, zero, x, x / 2), [[1, 0, 0]])  # an edge
    np.testing.assert_allclose(nearest_on_triangle(above, zero, zero, zero), [[0, 0, 0]])  # a point


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


DEVICE = Device(w=100, h=100, fl_x=400.0, fl_y=400.0, cx=50.0, cy=50.0)


def view(T_camera: np.ndarray, T_projector: np.ndarray) -> CaptureView:
    return CaptureView(DEVICE, T_camera, DEVICE, T_projector)


def test_of_a_sphere_exactly_what_faces_both_devices_is_observable() -> None:
    surface = IndexedMesh(sphere(10.0, 120))
    points, normals = surface.sample(4000, 0)
    camera, projector = looking_at_origin(400.0, 0.0, 0.0), looking_at_origin(500.0, 1.0, 0.0)
    seen = observable(points, normals, surface, [view(camera, projector)])
    heights = [(T[:3, 3] - points) @ np.eye(3) for T in (camera, projector)]
    cosines = np.array([(h * points / 10).sum(1) / np.linalg.norm(h, axis=1) for h in heights])
    clear = np.abs(cosines).min(0) > 0.05
    np.testing.assert_array_equal(seen[clear], (cosines > 0).all(0)[clear])


def test_frames_add_up_but_camera_and_projector_must_belong_to_one_frame_and_see_the_point() -> None:
    ball = sphere(10.0, 60)
    surface = IndexedMesh(ball)
    points, normals = surface.sample(2000, 0)
    front, back = looking_at_origin(400.0, 0.0, 0.0), looking_at_origin(400.0, np.pi, 0.0)
    aside = front.copy()
    aside[:3, 3] += 200 * front[:3, 0]
    shield = Mesh(np.array([[30.0, -50, -50], [30.0, 50, -50], [30.0, 0, 80]]), np.array([[0, 1, 2]]))

    def share(*pairs: tuple[np.ndarray, np.ndarray], among: Mesh = ball) -> float:
        return observable(points, normals, IndexedMesh(among), [view(*pair) for pair in pairs]).mean()

    assert 0.4 < share((front, front)) < 0.5 and share((front, front), (back, back)) > 0.9
    assert share((front, back)) == share((front, aside)) == share((front, front), among=together(ball, shield)) == 0
