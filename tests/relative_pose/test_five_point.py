"""First solutions from random samples: with exact rays, with wrong ones, over random geometry."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sl_nerfstudio.relative_pose.candidates import (
    essential_matrices,
    five_point_starts,
    in_front,
    poses_of,
)
from sl_nerfstudio.relative_pose.epipolar import (
    RELATIVE_POSE_DEFAULTS,
    RayPairs,
    SeparationSettings,
    distinct,
    ray_pairs,
)
from tests.relative_pose.two_views import PROJECTORS, View, view


def rays_of(frame: View) -> RayPairs:
    return ray_pairs(*frame.arguments)[0]


def truth_of(frame: View) -> tuple[np.ndarray, np.ndarray]:
    T = frame.T_camera_projector
    return T[:3, :3], T[:3, 3] / np.linalg.norm(T[:3, 3])


def errors_deg(R: np.ndarray, t: np.ndarray, frame: View) -> tuple[float, float]:
    R_true, t_true = truth_of(frame)
    return (
        float(np.degrees(Rotation.from_matrix(R_true.T @ R).magnitude())),
        float(np.degrees(np.arctan2(np.linalg.norm(np.cross(t, t_true)), t @ t_true))),
    )


def test_the_essential_matrix_of_five_exact_pairs_is_among_the_solutions():
    frame = view(count=200)
    rays, (R, t) = rays_of(frame), truth_of(frame)
    true = np.cross(t, R.T).T  # [t]x R, as d_camera . (t x R d_projector) = 0
    true = true / np.linalg.norm(true)
    for seed in range(20):
        sample = rays.chosen(np.random.default_rng(seed).choice(len(rays), 5, replace=False))
        found = essential_matrices(sample)
        assert 1 <= len(found) <= 10
        for E in found:
            assert np.abs(np.einsum("ni,ij,nj->n", sample.d_camera, E, sample.d_projector)).max() < 1e-8
        distance = [min(np.linalg.norm(s * E / np.linalg.norm(E) - true) for s in (1, -1)) for E in found]
        assert min(distance) < 1e-4


def test_of_the_four_poses_of_an_essential_matrix_the_one_in_front_is_kept():
    frame = view(count=5, seed=3)
    rays, (R, t) = rays_of(frame), truth_of(frame)
    (pose,) = poses_of(np.cross(t, R.T).T, rays)
    assert max(errors_deg(*pose, frame)) < 1e-6
    assert in_front(*pose, rays).all()
    assert not in_front(R, -t, rays).any()


@given(st.integers(0, 10**6))
def test_a_pair_is_in_front_where_both_depths_are_positive(seed):
    rng = np.random.default_rng(seed)
    R, t = Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3)
    d = rng.normal(size=(2, 40, 3))
    d = d / np.linalg.norm(d, axis=-1, keepdims=True)
    rays = RayPairs(d[0], d[1], np.zeros((40, 3, 2)), np.arange(40))
    for n, (a, b) in enumerate(zip(*d, strict=True)):
        depths = np.linalg.lstsq(np.stack([a, -R @ b], 1), t, rcond=None)[0]
        assert in_front(R, t, rays)[n] == (depths > 0).all()


def test_five_equal_pairs_have_no_solution_or_useless_ones():
    rays = rays_of(view(count=5))
    same = rays.chosen(np.zeros(5, dtype=np.int64))
    assert all(np.isfinite(E).all() for E in essential_matrices(same))


@settings(max_examples=8)
@given(st.integers(0, 10**6), st.sampled_from(sorted(PROJECTORS)), st.floats(-180, 180), st.floats(0, 2 * np.pi))
def test_from_exact_rays_the_best_start_is_the_true_pose(seed, projector, roll, bearing):
    frame = view(projector, offset=(np.cos(bearing), np.sin(bearing), 0.1), count=300, seed=seed, roll_deg=roll)
    R, t = five_point_starts(rays_of(frame), np.random.default_rng(seed))[0]
    assert max(errors_deg(R, t, frame)) < 1e-2
    assert np.linalg.det(R) == pytest.approx(1)
    assert np.linalg.norm(t) == pytest.approx(1)


@settings(max_examples=5)
@given(st.integers(0, 10**6), st.sampled_from(sorted(PROJECTORS)))
def test_a_third_of_wrong_coordinates_leaves_a_start_near_the_true_pose(seed, projector):
    frame = view(projector, count=1500, seed=seed).noisy(0.3, seed=seed, wrong=0.3)
    found = five_point_starts(rays_of(frame), np.random.default_rng(seed))
    assert min(sum(errors_deg(R, t, frame)) for R, t in found) < 10


def test_starts_differ_from_each_other():
    rays = rays_of(view(relief=0.02, count=1000).noisy(0.3, seed=1))
    found = five_point_starts(rays, np.random.default_rng(0))
    assert len(found) >= RELATIVE_POSE_DEFAULTS.five_point.starts
    for i, a in enumerate(found):
        assert all(distinct(a, b, RELATIVE_POSE_DEFAULTS.five_point.separation) for b in found[:i])
    wide = replace(RELATIVE_POSE_DEFAULTS.five_point, separation=SeparationSettings(10.0, 10.0))
    assert len(five_point_starts(rays, np.random.default_rng(0), replace(RELATIVE_POSE_DEFAULTS, five_point=wide))) == 1


def test_rays_that_are_no_image_points_are_not_sampled():
    """Nine tenths of the rays run sideways, where a device has no image point."""
    rays = rays_of(view(count=300))
    sideways = np.arange(len(rays)) % 10 > 0
    d = rays.d_camera.copy()
    d[sideways, 2] = 0.0
    for R, t in five_point_starts(replace(rays, d_camera=d), np.random.default_rng(0)):
        assert np.isfinite(R).all() and np.isfinite(t).all()
    d[:, 2] = 0.0
    assert five_point_starts(replace(rays, d_camera=d), np.random.default_rng(0)) == []
    assert five_point_starts(rays.chosen(np.arange(4)), np.random.default_rng(0)) == []


@settings(max_examples=30)
@given(st.floats(0, 0.2), st.floats(0, 0.2), st.integers(0, 10**6))
def test_poses_are_distinct_by_rotation_or_by_direction(angle, shift, seed):
    rng = np.random.default_rng(seed)
    axis, t = rng.standard_normal(3), rng.standard_normal(3)
    t = t / np.linalg.norm(t)
    turned = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
    across = np.cross(t, axis)
    moved = Rotation.from_rotvec(shift * np.cross(t, across) / np.linalg.norm(np.cross(t, across))).apply(t)
    limit = SeparationSettings(0.05, 0.1)
    assume(abs(angle - 0.05) > 1e-3 and abs(shift - 0.1) > 1e-3)
    assert distinct((np.eye(3), t), (turned, moved), limit) is (angle > 0.05 or shift > 0.1)
