"""Heights above a plane: without the error of a frame's pose, and with the errors that the points really have."""

import numpy as np
import pytest

from sl_nerfstudio.object_separation.planes import (
    SEPARATION_DEFAULTS,
    FramePlane,
    FramePoints,
    Plane,
    find_bare_places,
    on_plane,
    plane_in_frame,
)

TABLE = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
SIGMA = 0.1
OWN = FramePlane(TABLE, 1.0)


def _points(p):
    """Points seen from straight above, so that sigma is that of the height."""
    ray = np.tile([0.0, 0.0, -1.0], (len(p), 1))
    return FramePoints(np.arange(len(p)), np.zeros(len(p), np.int64), p, ray, np.full(len(p), SIGMA))


def _table(rng, half=50.0, count=20_000):
    xy = rng.uniform(-half, half, (count, 2))
    return np.column_stack([xy, SIGMA * rng.standard_normal(count)])


def test_the_tilt_and_the_height_of_a_wrong_pose_are_taken_out():
    rng = np.random.default_rng(0)
    p = _table(rng, count=4000)
    true = Plane(np.array([0.004, -0.003, 1.0]) / np.linalg.norm([0.004, -0.003, 1.0]), 0.15)
    moved = p + 0.0
    moved[:, 2] += (true.offset - p[:, :2] @ true.normal[:2]) / true.normal[2]
    body = np.column_stack([rng.uniform(-10, 10, (1500, 2)), rng.uniform(2, 40, 1500)])
    found = plane_in_frame(TABLE, _points(np.concatenate([moved, body])), 2.0, 60.0, SEPARATION_DEFAULTS)
    corners = np.array(
        [[x, y, (true.offset - true.normal[:2] @ [x, y]) / true.normal[2]] for x in (-50, 50) for y in (-50, 50)]
    )
    assert np.abs(found.plane.heights(corners)).max() < 0.5 * SIGMA
    assert found.noise == pytest.approx(1.0, abs=0.1)


def test_a_frame_with_few_points_on_the_plane_keeps_the_common_one():
    few = _points(_table(np.random.default_rng(1), count=40))
    assert plane_in_frame(TABLE, few, 1.7, 60.0, SEPARATION_DEFAULTS) == FramePlane(TABLE, 1.7)


def test_of_points_with_normal_errors_only_those_within_the_stated_noise_are_the_plane():
    rng = np.random.default_rng(2)
    points = _points(_table(rng))
    places = find_bare_places(TABLE, [(points, OWN)], 2.0, SEPARATION_DEFAULTS)
    assert places.near == SEPARATION_DEFAULTS.plane_sigmas and places.bare == 9.0
    assert on_plane(points, OWN, places).mean() == 1.0
    low = _points(np.column_stack([rng.uniform(-9, 9, (500, 2)), np.full(500, 0.95)]))  # 9.5 sigma
    assert not on_plane(low, OWN, places).any()


def test_a_thin_object_on_the_plane_is_not_part_of_it():
    """A coin, 1 mm thick: ten sigma."""
    rng = np.random.default_rng(3)
    p = _table(rng)
    coin = np.hypot(p[:, 0], p[:, 1]) < 15
    p[coin, 2] += 1.0
    points = _points(p)
    found = on_plane(points, OWN, find_bare_places(TABLE, [(points, OWN)], 2.0, SEPARATION_DEFAULTS))
    inner = np.hypot(p[:, 0], p[:, 1]) < 12
    assert not found[inner].any() and found[~coin].mean() > 0.995


def test_errors_beside_what_rises_are_measured_below_the_plane():
    """Around a body the decoder errs by ten times the noise, upwards and downwards."""
    rng = np.random.default_rng(4)
    p = _table(rng, count=40_000)
    beside = (np.abs(p[:, 0]) < 8) & (np.abs(p[:, 1]) < 8)
    p[beside, 2] *= 10
    body = np.column_stack([rng.uniform(-8, 8, (3000, 2)), rng.uniform(0, 30, 3000)])
    points = _points(np.concatenate([p, body]))
    places = find_bare_places(TABLE, [(points, OWN)], 2.0, SEPARATION_DEFAULTS)
    assert 15 < places.near < 28
    found = on_plane(points, OWN, places)
    assert found[: len(p)].mean() > 0.99
    assert not found[len(p) :][body[:, 2] > 10].any()


def test_the_side_of_a_plate_is_no_error():
    """Points far below the plane at its edge, where nothing rises."""
    rng = np.random.default_rng(5)
    p = _table(rng)
    side = np.column_stack([np.full(3000, 50.0), rng.uniform(-50, 50, 3000), rng.uniform(-2.9, 0, 3000)])
    body = np.column_stack([rng.uniform(-8, 8, (3000, 2)), rng.uniform(0, 30, 3000)])
    places = find_bare_places(TABLE, [(_points(np.concatenate([p, side, body])), OWN)], 2.0, SEPARATION_DEFAULTS)
    assert places.near < 4
