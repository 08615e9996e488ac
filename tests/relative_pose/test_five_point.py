"""First solutions from random samples: with exact rays, with wrong ones, over random geometry."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sl_nerfstudio.relative_pose.epipolar_fit import distinct
from sl_nerfstudio.relative_pose.five_point import essential_matrices, five_point_candidates, in_front, poses_of
from sl_nerfstudio.relative_pose.ray_pairs import RayPairs, ray_pairs
from sl_nerfstudio.relative_pose.settings import RELATIVE_POSE_DEFAULTS, Separation
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


def test_five_equal_pairs_have_no_solution_or_useless_ones():
    rays = rays_of(view(count=5))
    same = rays.chosen(np.zeros(5, dtype=np.int64))
    assert all(np.isfinite(E).all() for E in essential_matrices(same))


@settings(max_examples=12)
@given(
    st.integers(0, 10**6),
    st.sampled_from(sorted(PROJECTORS)),
    st.floats(-180, 180),
    st.floats(0, 2 * np.pi),
    st.floats(-0.8, 0.8),
)
def test_from_exact_rays_the_true_pose_is_the_best_candidate(seed, projector, roll, bearing, ahead):
    offset = (np.cos(bearing), np.sin(bearing), ahead)
    frame = view(projector, offset=offset, count=300, seed=seed, roll_deg=roll)
    rays = rays_of(frame)
    found = five_point_candidates(rays, np.random.default_rng(seed))
    best = found[0]
    assert max(errors_deg(best.fit.R, best.fit.t, frame)) < 1e-4
    assert best.in_front == 1.0
    assert best.fit.noise_px == pytest.approx(RELATIVE_POSE_DEFAULTS.fit.noise_floor_px)
    assert [c.fit.noise_px for c in found] == sorted(c.fit.noise_px for c in found)
    assert np.linalg.det(best.fit.R) == pytest.approx(1)
    assert np.linalg.norm(best.fit.t) == pytest.approx(1)


@settings(max_examples=12)
@given(st.integers(0, 10**6), st.sampled_from(sorted(PROJECTORS)))
def test_a_third_of_wrong_coordinates_does_not_hide_the_true_pose(seed, projector):
    frame = view(projector, count=1500, seed=seed).noisy(0.3, seed=seed, wrong=0.3)
    found = five_point_candidates(rays_of(frame), np.random.default_rng(seed))
    rotation, direction = errors_deg(found[0].fit.R, found[0].fit.t, frame)
    assert rotation < 1
    assert direction < 1
    assert found[0].in_front > 0.95


def test_candidates_differ_from_each_other():
    frame = view(relief=0.02, count=1000).noisy(0.3, seed=1)  # nearly a plane: two solutions
    separation = RELATIVE_POSE_DEFAULTS.five_point.solution_separation
    found = five_point_candidates(rays_of(frame), np.random.default_rng(0))
    assert len(found) > 1
    for i, a in enumerate(found):
        for b in found[:i]:
            assert distinct((a.fit.R, a.fit.t), (b.fit.R, b.fit.t), separation)
    wide = replace(RELATIVE_POSE_DEFAULTS.five_point, solution_separation=Separation(10.0, 10.0))
    one = five_point_candidates(
        rays_of(frame), np.random.default_rng(0), replace(RELATIVE_POSE_DEFAULTS, five_point=wide)
    )
    assert len(one) == 1


def test_rays_that_are_no_image_points_are_not_sampled():
    """Nine tenths of the rays run sideways, where a device has no image point."""
    frame = view(count=300)
    rays = rays_of(frame)
    sideways = np.arange(len(rays)) % 10 > 0
    d = rays.d_camera.copy()
    d[sideways, 2] = 0.0
    found = five_point_candidates(replace(rays, d_camera=d), np.random.default_rng(0))
    assert found == [] or np.isfinite(found[0].fit.R).all()
    d[:, 2] = 0.0
    assert five_point_candidates(replace(rays, d_camera=d), np.random.default_rng(0)) == []
    assert five_point_candidates(rays.chosen(np.arange(4)), np.random.default_rng(0)) == []


def test_random_coordinates_fit_badly():
    frame = view(count=1000)
    uv = np.random.default_rng(99).uniform(0, 800, frame.uv_projector.shape)
    found = five_point_candidates(rays_of(replace(frame, uv_projector=uv)), np.random.default_rng(0))
    assert all(c.fit.noise_px > 100 for c in found)


@settings(max_examples=30)
@given(st.floats(0, 0.2), st.floats(0, 0.2), st.integers(0, 10**6))
def test_poses_are_distinct_by_rotation_or_by_direction(angle, shift, seed):
    rng = np.random.default_rng(seed)
    axis, t = rng.standard_normal(3), rng.standard_normal(3)
    t = t / np.linalg.norm(t)
    turned = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
    across = np.cross(t, axis)
    moved = Rotation.from_rotvec(shift * np.cross(t, across) / np.linalg.norm(np.cross(t, across))).apply(t)
    limit = Separation(0.05, 0.1)
    assume(abs(angle - 0.05) > 1e-3 and abs(shift - 0.1) > 1e-3)
    assert distinct((np.eye(3), t), (turned, moved), limit) is (angle > 0.05 or shift > 0.1)
