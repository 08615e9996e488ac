"""The point that all axes pass nearest, and how far the devices see around it."""

import numpy as np
import pytest

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.object_separation.planes import DecodedFrame, viewed_region
from sl_nerfstudio.synthesis.devices import look_at

CENTRE = np.array([10.0, -20.0, 30.0])


def _frames(positions, target, fl=500.0, projector_fl=400.0):
    camera, projector = Device(200, 100, fl, fl, 100.0, 50.0), Device(100, 100, projector_fl, projector_fl, 50.0, 50.0)
    nothing = np.full((100, 200, 2), np.nan, np.float32)
    return [
        DecodedFrame(camera, projector, T, T, nothing, np.zeros((100, 200), bool))
        for T in look_at(positions, target, np.zeros(len(positions)))
    ]


def test_cameras_that_look_at_a_point_share_it_and_the_narrower_device_limits_the_radius():
    rng = np.random.default_rng(0)
    direction = rng.standard_normal((8, 3))
    positions = CENTRE + 400 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    region = viewed_region(_frames(positions, CENTRE), CENTRE + rng.normal(0, 5, (50, 3)))
    np.testing.assert_allclose(region.focus, CENTRE, atol=1.0)
    assert region.radius == pytest.approx(400 * 100 / 500 / 2, rel=0.01)  # 100 rows at a focal length of 500
    assert region.contains(np.stack([CENTRE, CENTRE + 60])).tolist() == [True, False]
    wide = viewed_region(_frames(positions, CENTRE, projector_fl=1000.0), CENTRE + rng.normal(0, 5, (50, 3)))
    assert wide.radius == pytest.approx(400 * 100 / 1000 / 2, rel=0.01)


def test_where_all_axes_are_parallel_the_points_decide():
    positions = np.array([[0.0, 0, 300], [50, 0, 300], [0, 50, 300]])
    T = look_at(positions, positions - [0, 0, 1.0], np.zeros(3))
    frames = [f for f in _frames(positions, positions - [0, 0, 1.0])]
    np.testing.assert_allclose([f.T_world_camera for f in frames], T)
    points = np.array([[20.0, 10, 40]]) + np.random.default_rng(1).normal(0, 1, (99, 3))
    assert viewed_region(frames, points).focus[2] == pytest.approx(40, abs=1)
