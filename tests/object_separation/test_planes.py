"""Points of frames, the planes in them, what is told of each plane, and what rises from it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.object_separation import planes
from sl_nerfstudio.object_separation.planes import (
    DecodedFrame,
    FramePlane,
    FramePoints,
    Plane,
    PointPool,
    cross_frame_noise,
    find_bare_places,
    find_planes,
    fit_plane,
    grown_planes,
    normals_of,
    on_plane,
    plane_in_frame,
    points_of,
    viewed_region,
)
from sl_nerfstudio.synthesis.devices import look_at

# Points.


def test_points_of_the_table_scatter_about_it_by_their_stated_sigma(cases):
    case = cases("box", "table")
    ratios = []
    for frame, is_object in zip(case.frames, case.is_object, strict=True):
        points = points_of(frame)
        table = ~is_object[points.row, points.column]
        z = points.p_world[table, 2]
        up = np.array([0.0, 0.0, 1.0])
        off = z - np.median(z)  # without the error of the frame's pose
        ratios.append(1.4826 * np.median(np.abs(off) / points.sigma_along(up)[table]))
    assert 0.7 < np.median(ratios) < 1.6


def test_a_thinned_frame_has_the_same_points(cases):
    frame = cases("box", "table").frames[0]
    thin = frame.thinned(600)
    assert 300 < np.isfinite(thin.coords).all(-1).sum() <= 700 and thin.stride > 1
    few, all_ = points_of(thin), points_of(frame)
    place = {(r, c): p for r, c, p in zip(all_.row.tolist(), all_.column.tolist(), all_.p_world, strict=True)}
    same = [place[r * thin.stride, c * thin.stride] for r, c in zip(few.row.tolist(), few.column.tolist(), strict=True)]
    np.testing.assert_allclose(few.p_world, same, atol=1e-9)


def test_normals_look_at_the_camera_and_are_those_of_the_surface(cases, monkeypatch):
    case = cases("box", "table")
    points = points_of(case.frames[0])
    monkeypatch.setattr(planes, "NEIGHBOURS", 40)
    normals = normals_of(points)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
    assert ((normals * points.ray).sum(1) <= 0).all()
    table = ~case.is_object[0][points.row, points.column]
    assert np.median(normals[table, 2]) > 0.95
    assert np.isnan(normals_of(points.chosen(np.arange(5)))).all()


def test_poses_that_disagree_show_as_noise(cases):
    frames = cases("box", "table").frames
    points = [points_of(f.thinned(1500)) for f in frames]
    good = cross_frame_noise(points, [normals_of(p) for p in points])
    lifted = []
    for k, frame in enumerate(frames):
        S = Similarity(1.0, np.eye(3), np.array([0.0, 0.0, 1.5 * (-1) ** k]))
        T_camera, T_projector = S.poses(frame.T_world_camera), S.poses(frame.T_world_projector)
        lifted.append(replace(frame, T_world_camera=T_camera, T_world_projector=T_projector))
    apart = [points_of(f.thinned(1500)) for f in lifted]
    assert cross_frame_noise(apart, [normals_of(p) for p in apart]) > 2 * good
    assert cross_frame_noise(points[:1], [normals_of(points[0])]) == 1.0
    assert len(points_of(replace(frames[0], coords=np.full_like(frames[0].coords, np.nan)))) == 0


@given(st.integers(0, 2**31 - 1))
def test_a_fit_gives_back_the_plane_whatever_the_weights(seed):
    rng = np.random.default_rng(seed)
    normal = rng.standard_normal(3)
    plane = Plane(normal / np.linalg.norm(normal), float(rng.uniform(-50, 50)))
    np.testing.assert_allclose(plane.axes() @ np.vstack([plane.axes(), plane.normal]).T, np.eye(2, 3), atol=1e-12)
    p = plane.offset * plane.normal + rng.uniform(-30, 30, (40, 2)) @ plane.axes()
    found = fit_plane(p, rng.uniform(0.1, 10, 40))
    np.testing.assert_allclose(plane.heights(p), 0, atol=1e-9)
    np.testing.assert_allclose(found.heights(p), 0, atol=1e-8)
    assert abs(found.normal @ plane.normal) == pytest.approx(1)
    p = rng.standard_normal((5, 3))
    np.testing.assert_allclose(plane.flipped().heights(p), -plane.heights(p))


# Planes in clouds with outliers and curved parts.


SIGMA = 0.1


def _seen(p, camera=(20.0, -30.0, 400.0)):
    ray = p - np.array(camera)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    return FramePoints(np.arange(len(p)), np.zeros(len(p), np.int64), p, ray, np.full(len(p), SIGMA))


def _pool(*parts):
    frames = [_seen(part) for part in parts]
    return PointPool.of(frames, [normals_of(f) for f in frames])


def _slab(rng, count, z):
    return np.column_stack([rng.uniform(-60, 60, (count, 2)), z + 0.1 * rng.standard_normal(count)])


def _ball(rng, count):
    d = rng.standard_normal((count, 3))
    return 20 * d / np.linalg.norm(d, axis=1, keepdims=True) + [0, 0, 40.0]


def test_planes_are_found_the_largest_first_among_curved_parts_and_outliers():
    rng = np.random.default_rng(0)
    frames = [
        np.concatenate([_slab(rng, 2000, 0.0), _slab(rng, 900, 12.0), _ball(rng, 1500), rng.uniform(-80, 80, (200, 3))])
        for _ in range(2)
    ]
    found = find_planes(_pool(*frames), 80.0, rng)
    offsets = [abs(plane.offset) for plane, _ in found[:2]]
    assert offsets == pytest.approx([0.0, 12.0], abs=0.05)
    assert all(abs(plane.normal[2]) > 0.9999 for plane, _ in found[:2])
    shares = [share for _, share in found]
    assert shares == sorted(shares, reverse=True) and 0.35 < shares[0] < 0.45


def test_a_plane_of_one_frame_only_and_a_ball_are_no_planes():
    rng = np.random.default_rng(1)
    pool = _pool(np.concatenate([_slab(rng, 1500, 0.0), _ball(rng, 500)]), _ball(rng, 2000))
    assert find_planes(pool, 80.0, rng) == []
    assert find_planes(_pool(_ball(rng, 3000), _ball(rng, 3000)), 80.0, rng) == []


def test_grown_planes_are_those_of_the_fit_step_by_step():
    """The compiled loop against the definition: three fits, each to the points of the plane before it."""
    rng = np.random.default_rng(2)
    pool = _pool(*[np.concatenate([_slab(rng, 300, 0.0), _ball(rng, 200), rng.uniform(-80, 80, (50, 3))])] * 2)
    p, radius = pool.points.p_world, 80.0
    seeds = rng.integers(0, len(pool), 40)
    planes, counts = grown_planes(pool.points, pool.normal, seeds, radius)
    for seed, found, count in zip(seeds, planes, counts, strict=True):
        plane = Plane(pool.normal[seed], float(pool.normal[seed] @ p[seed]))
        for reach in (0.2 * radius, 0.5 * radius, np.inf):
            on = pool.on(plane) & (np.linalg.norm(p - p[seed], axis=1) < reach)
            if on.sum() >= 6:
                fitted = fit_plane(p[on], 1 / pool.points.chosen(on).sigma_along(plane.normal) ** 2)
                plane = fitted if fitted.normal @ plane.normal > 0 else fitted.flipped()
        assert found == pytest.approx([*plane.normal, plane.offset], abs=1e-9)
        assert count == pool.on(plane).sum()
    assert len(set(counts.tolist())) > 5


# The region on which all devices look.


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
    frames = _frames(positions, positions - [0, 0, 1.0])
    points = np.array([[20.0, 10, 40]]) + np.random.default_rng(1).normal(0, 1, (99, 3))
    assert viewed_region(frames, points).focus[2] == pytest.approx(40, abs=1)


# Every plane of a case, and why it is surroundings or part of the object.


@pytest.mark.slow
@pytest.mark.parametrize(("background", "verdict"), [("table", "leaves the views"), ("plate", "object stands on it")])
def test_the_supporting_plane_is_found_where_it_is(separated, background, verdict):
    """The box stands on z = 0; a plate as large as the box is high has edges that the frames see."""
    found = separated("box", background, 0.6).findings[0]
    assert (found.verdict, found.is_surroundings) == (verdict, True)
    assert found.plane.normal[2] > 0.9999 and abs(found.plane.offset) < 0.15


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "count", "reasons"),
    [("box", 4, {"cameras on both sides", "surface behind it"}), ("plaque", 1, {"edges seen", "surface behind it"})],
)
def test_sides_of_an_object_are_part_of_it(separated, name, count, reasons):
    found = separated(name, "none").findings
    assert len(found) >= count and not any(f.is_surroundings for f in found)
    assert {f.verdict for f in (found if name == "box" else found[:1])} <= reasons
    assert name == "box" or found[0].plane.normal[2] > 0.999  # the face of a plaque alone


# Heights above a plane: without the error of a frame's pose, and with the errors that the points really have.


TABLE = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
OWN = FramePlane(TABLE, 1.0)


def _points(p):
    """Points seen from straight above, so that sigma is that of the height."""
    return replace(_seen(p), ray=np.tile([0.0, 0.0, -1.0], (len(p), 1)))


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
    found = plane_in_frame(TABLE, _points(np.concatenate([moved, body])), 2.0, 60.0)
    xy = np.array([[-50.0, -50.0], [-50.0, 50.0], [50.0, -50.0], [50.0, 50.0]])
    corners = np.column_stack([xy, (true.offset - xy @ true.normal[:2]) / true.normal[2]])
    assert np.abs(found.plane.heights(corners)).max() < 0.5 * SIGMA
    assert found.noise == pytest.approx(1.0, abs=0.1)


def test_a_frame_with_few_points_on_the_plane_keeps_the_common_one():
    few = _points(_table(np.random.default_rng(1), count=40))
    assert plane_in_frame(TABLE, few, 1.7, 60.0) == FramePlane(TABLE, 1.7)


def test_of_points_with_normal_errors_only_those_within_the_stated_noise_are_the_plane():
    rng = np.random.default_rng(2)
    points = _points(_table(rng))
    places = find_bare_places(TABLE, [(points, OWN)], 2.0)
    assert places.near == 3.0 and places.bare == 9.0
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
    found = on_plane(points, OWN, find_bare_places(TABLE, [(points, OWN)], 2.0))
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
    places = find_bare_places(TABLE, [(points, OWN)], 2.0)
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
    places = find_bare_places(TABLE, [(_points(np.concatenate([p, side, body])), OWN)], 2.0)
    assert places.near < 4
