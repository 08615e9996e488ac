"""Planes in point clouds with outliers and curved parts."""

import numpy as np
import pytest

from sl_nerfstudio.object_separation.frame_points import FramePoints, normals_of
from sl_nerfstudio.object_separation.plane_search import PointPool, find_planes
from sl_nerfstudio.object_separation.settings import SEPARATION_DEFAULTS


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
