"""Pyramids of devices end where the rays of their image's corners do; a viewpoint sees all that it should."""

import math

import numpy as np
import pytest

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.triangulation import OUTLINE, beside, far_enough, frustum

DEVICE = Device(w=640, h=400, fl_x=700.0, fl_y=650.0, cx=300.0, cy=210.0)
TURNED = np.array([[0.0, -1.0, 0.0, 3.0], [0.0, 0.0, -1.0, 4.0], [1.0, 0.0, 0.0, 5.0], [0.0, 0.0, 0.0, 1.0]])


def test_corners_lie_on_the_rays_of_the_images_corners():
    points = frustum(DEVICE, TURNED, 2.0)
    np.testing.assert_allclose(points[0], [3, 4, 5])
    for k, (x, y) in enumerate([(0, 0), (640, 0), (640, 400), (0, 400)], 1):
        ray = np.array([(x - 300.0) / 700.0, -(y - 210.0) / 650.0, -1.0])
        expected = TURNED[:3, :3] @ (2.0 * ray / np.linalg.norm(ray)) + [3, 4, 5]
        np.testing.assert_allclose(points[k], expected, atol=1e-6)
    above = TURNED[:3, 1]  # the device's up, in the world
    assert (points[7] - points[5]) @ above > 0 and (points[1] - points[4]) @ above > 0
    np.testing.assert_allclose(np.cross(points[5] - points[1], points[2] - points[1]), 0, atol=1e-9)


def test_the_outline_draws_all_edges():
    drawn = {frozenset(pair) for pair in zip(OUTLINE.tolist(), OUTLINE[1:].tolist(), strict=False)}
    rays, sides = {frozenset((0, k)) for k in (1, 2, 3, 4)}, {frozenset(p) for p in ((1, 2), (2, 3), (3, 4), (4, 1))}
    assert rays | sides | {frozenset((5, 7)), frozenset((7, 6))} <= drawn
    assert drawn - rays - sides <= {frozenset(p) for p in ((1, 5), (5, 7), (7, 6), (6, 2))}  # along the upper edge


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("aspect", [0.6, 1.0, 1.8])
def test_a_viewpoint_sees_every_point_and_is_no_farther_away_than_needed(seed, aspect):
    rng = np.random.default_rng(seed)
    points, centre, up, fov = rng.normal(size=(60, 3)), rng.normal(size=3), rng.normal(size=3), 0.9
    direction = beside(rng.normal(size=3), up)
    view = far_enough(np.concatenate([points, [[np.nan] * 3]]), centre, direction, up, fov, aspect, margin=1.0)
    back = (view.eye - view.centre) / np.linalg.norm(view.eye - view.centre)
    right = np.cross(view.up, back)
    right /= np.linalg.norm(right)
    seen = (points - view.eye) @ np.stack([right, np.cross(back, right), -back], 1)
    assert (seen[:, 2] > 0).all()
    edges = np.abs(seen[:, :2] / seen[:, 2:]) / (math.tan(fov / 2) * np.array([aspect, 1.0]))
    assert edges.max() == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(back, direction, atol=1e-9)


def test_the_direction_is_beside_and_above_the_first_camera():
    z = np.array([0.0, 0.0, 2.0])
    direction = beside(np.array([3.0, 0.0, 0.0]), z)
    assert np.linalg.norm(direction) == pytest.approx(1)
    assert math.asin(direction[2]) == pytest.approx(0.3) and math.atan2(direction[1], direction[0]) == pytest.approx(
        0.35
    )
    for straight in (z, -z):
        assert np.isfinite(beside(straight, z)).all() and np.linalg.norm(beside(straight, z)) == pytest.approx(1)
    assert math.asin(beside(np.array([0.1, 0.0, 5.0]), z)[2]) == pytest.approx(1.2)  # never from straight above


def test_nothing_to_see_is_no_fault():
    view = far_enough(np.full((1, 3), np.nan), np.zeros(3), np.array([1.0, 0, 0]), np.array([0.0, 0, 1]), 0.8, 1.0)
    assert np.isfinite(view.eye).all()
