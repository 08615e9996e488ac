"""Predicted coordinates against the formulas of a ball, and what is in the way of light."""

import numpy as np
import pytest

from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.redecoding.redecode import PredictedSurface
from tests.redecoding.lit_ball import CAMERA, PROJECTOR, T_CAMERA, T_PROJECTOR, ball, seen_at, truth


@pytest.fixture(scope="module")
def predicted():
    return PredictedSurface(ball()).predict(CAMERA, PROJECTOR, T_CAMERA, T_PROJECTOR)


def test_coordinates_are_those_of_the_ball(predicted):
    both = predicted.known & np.isfinite(truth()).all(-1)
    assert (predicted.known != np.isfinite(truth()).all(-1)).mean() < 0.01  # the mesh's outline has corners
    error = np.linalg.norm(predicted.coords - truth(), axis=-1)[both]
    assert np.median(error) < 0.05 and np.quantile(error, 0.99) < 1  # large only where rays graze the facets


def test_a_point_that_moves_along_its_ray_moves_its_coordinate_along_the_stated_direction(predicted):
    row, column = 70, 84
    seen = seen_at(np.array([column + 0.5]), np.array([row + 0.5]))
    ray = seen.p_world[0] - T_CAMERA[:3, 3]
    moved = seen.p_world[0] + 0.01 * ray
    q = (moved - T_PROJECTOR[:3, 3]) @ T_PROJECTOR[:3, :3]
    uv = np.array([PROJECTOR.fl_x * q[0] / -q[2] + PROJECTOR.cx, -PROJECTOR.fl_y * q[1] / -q[2] + PROJECTOR.cy])
    way = uv - seen.coords[0]
    np.testing.assert_allclose(predicted.along[row, column], way / np.linalg.norm(way), atol=2e-3)
    assert predicted.depth[row, column] * CAMERA.fl_x == pytest.approx(np.linalg.norm(ray), abs=0.05)


def test_there_is_no_prediction_in_the_shadow_of_something_else():
    way = T_PROJECTOR[:3, 3] / np.linalg.norm(T_PROJECTOR[:3, 3])
    side = np.cross(way, [0.0, 0, 1])
    corners = 150 * way + 20 * np.array([side, [0, 0, 1], -side, [0, 0, -1.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]]) + len(ball().vertices)
    shaded = Mesh(np.concatenate([ball().vertices, corners]), np.concatenate([ball().faces, faces]))
    found = PredictedSurface(shaded).predict(CAMERA, PROJECTOR, T_CAMERA, T_PROJECTOR)
    light = np.abs(truth() - 200).max(-1)  # the plate is about the middle of the light
    assert not found.known[light < 60].any() and found.known[(light > 155) & (light < 170)].mean() > 0.9


def test_a_far_away_origin_changes_nothing(predicted):
    shift = np.array([1e5, -2e5, 3e5])
    T_camera, T_projector = T_CAMERA.copy(), T_PROJECTOR.copy()
    T_camera[:3, 3] += shift
    T_projector[:3, 3] += shift
    moved = Mesh(ball().vertices + shift, ball().faces)
    found = PredictedSurface(moved).predict(CAMERA, PROJECTOR, T_camera, T_projector)
    same = found.known & predicted.known
    assert (found.known == predicted.known).mean() > 0.999
    np.testing.assert_allclose(found.coords[same], predicted.coords[same], atol=0.02)
