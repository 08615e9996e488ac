"""Planes in point clouds with outliers and curved parts."""

import numpy as np
import pytest

from sl_nerfstudio.object_separation.planes import (
    SEPARATION_DEFAULTS,
    FramePoints,
    Plane,
    PointPool,
    find_planes,
    fit_plane,
    grown_planes,
    normals_of,
)


def _frame(p, camera=(20.0, -30.0, 400.0)):
    ray = p - np.array(camera)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    return FramePoints(np.arange(len(p)), np.zeros(len(p), np.int64), p, ray, np.full(len(p), 0.1))


def _pool(*parts):
    frames = [_frame(part) for part in parts]
    return PointPool.of(frames, [normals_of(f, SEPARATION_DEFAULTS.neighbours) for f in frames])


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
    found = find_planes(_pool(*frames), 80.0, rng, SEPARATION_DEFAULTS)
    offsets = [abs(plane.offset) for plane, _ in found[:2]]
    assert offsets == pytest.approx([0.0, 12.0], abs=0.05)
    assert all(abs(plane.normal[2]) > 0.9999 for plane, _ in found[:2])
    shares = [share for _, share in found]
    assert shares == sorted(shares, reverse=True) and 0.35 < shares[0] < 0.45


def test_a_plane_of_one_frame_only_and_a_ball_are_no_planes():
    rng = np.random.default_rng(1)
    pool = _pool(np.concatenate([_slab(rng, 1500, 0.0), _ball(rng, 500)]), _ball(rng, 2000))
    assert find_planes(pool, 80.0, rng, SEPARATION_DEFAULTS) == []
    assert find_planes(_pool(_ball(rng, 3000), _ball(rng, 3000)), 80.0, rng, SEPARATION_DEFAULTS) == []


def test_grown_planes_are_those_of_the_fit_step_by_step():
    """The compiled loop against the definition: three fits, each to the points of the plane before it."""
    rng, s = np.random.default_rng(2), SEPARATION_DEFAULTS
    pool = _pool(*[np.concatenate([_slab(rng, 300, 0.0), _ball(rng, 200), rng.uniform(-80, 80, (50, 3))])] * 2)
    p, radius = pool.points.p_world, 80.0
    seeds = rng.integers(0, len(pool), 40)
    planes, counts = grown_planes(pool.points, pool.normal, seeds, radius, s.search_sigmas, s.normal_cosine)
    for seed, found, count in zip(seeds, planes, counts, strict=True):
        plane = Plane(pool.normal[seed], float(pool.normal[seed] @ p[seed]))
        for reach in (0.2 * radius, 0.5 * radius, np.inf):
            on = pool.on(plane, s) & (np.linalg.norm(p - p[seed], axis=1) < reach)
            if on.sum() >= 6:
                fitted = fit_plane(p[on], 1 / pool.points.chosen(on).sigma_along(plane.normal) ** 2)
                plane = fitted if fitted.normal @ plane.normal > 0 else fitted.flipped()
        assert found == pytest.approx([*plane.normal, plane.offset], abs=1e-9)
        assert count == pool.on(plane, s).sum()
    assert len(set(counts.tolist())) > 5
