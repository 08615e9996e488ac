from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.devices import Intrinsics
from sl_nerfstudio.geometry.triangulation import epipolar_residual
from sl_nerfstudio.relative_pose.epipolar import (
    covariance,
    direction_basis,
    fit_epipolar,
    moved,
    ray_pairs,
    sampson,
    sampson_jacobian,
)
from sl_nerfstudio.relative_pose.estimation import RelativePoseError, estimate_relative_pose
from tests.relative_pose.two_views import PROJECTORS, errors_deg, view


@pytest.mark.parametrize("projector", PROJECTORS)
def test_exact_coordinates_give_the_exact_pose(projector):
    frame = view(projector, count=500)
    found = estimate_relative_pose(*frame.arguments)
    rotation, direction = errors_deg(found.T_camera_projector, frame.T_camera_projector)
    assert max(rotation, direction) < 1e-6
    assert np.linalg.norm(found.T_camera_projector[:3, 3]) == pytest.approx(1, abs=1e-12)
    assert found.inliers.all()
    assert not found.degeneracies


@settings(max_examples=6)
@given(st.integers(0, 10**6), st.sampled_from(sorted(PROJECTORS)), st.floats(-180, 180), st.floats(0, 2 * np.pi))
def test_any_side_and_any_roll_of_the_projector_is_found(seed, projector, roll, bearing):
    offset = (1.2 * np.cos(bearing), 1.2 * np.sin(bearing), -0.1)
    frame = view(projector, offset=offset, count=300, seed=seed, roll_deg=roll)
    found = estimate_relative_pose(*frame.arguments, seed=seed)
    assert max(errors_deg(found.T_camera_projector, frame.T_camera_projector)) < 1e-6


@pytest.mark.parametrize("projector", PROJECTORS)
def test_noise_and_wrong_coordinates_leave_the_pose_within_a_tenth_of_a_degree_or_so(projector):
    frame = view(projector).noisy(0.3, seed=3, wrong=0.2)
    found = estimate_relative_pose(*frame.arguments)
    rotation, direction = errors_deg(found.T_camera_projector, frame.T_camera_projector)
    assert rotation < 0.2
    assert direction < 0.2
    assert 0.75 < found.inliers.mean() < 0.85
    assert found.residual_px == pytest.approx(0.3, rel=0.35)  # a fifth of wrong ones widens the median


def test_the_seed_alone_decides_the_result():
    frame = view(count=300).noisy(0.3, seed=1, wrong=0.1)
    a, b = (estimate_relative_pose(*frame.arguments, seed=5) for _ in range(2))
    assert np.array_equal(a.T_camera_projector, b.T_camera_projector)
    assert np.array_equal(a.covariance, b.covariance)


@pytest.mark.parametrize("projector", PROJECTORS)
def test_the_residual_is_the_distance_from_the_epipolar_curve(projector):
    """Against the independent formula of geometry.epipolar, which projects the curve and measures in the image."""
    frame = view(projector, count=200).noisy(0.05, seed=2)
    rays, _ = ray_pairs(*frame.arguments)
    T = frame.T_camera_projector
    ours = sampson(T[:3, :3], T[:3, 3] / np.linalg.norm(T[:3, 3]), rays)
    theirs = epipolar_residual(
        Intrinsics.of(frame.camera, torch.float64),
        torch.eye(4, dtype=torch.float64),
        torch.from_numpy(frame.uv_camera),
        Intrinsics.of(frame.projector, torch.float64),
        torch.from_numpy(T),
        torch.from_numpy(frame.uv_projector),
    ).numpy()
    np.testing.assert_allclose(np.abs(ours), np.abs(theirs), atol=2e-5)


@pytest.mark.parametrize("projector", PROJECTORS)
def test_derivatives_are_those_of_differences(projector):
    frame = view(projector, count=30).noisy(1.0, seed=4)
    rays, _ = ray_pairs(*frame.arguments)
    R, t = frame.T_camera_projector[:3, :3], frame.T_camera_projector[:3, 3]
    t = t / np.linalg.norm(t)
    _, J = sampson_jacobian(R, t, rays)
    h = 1e-6
    for k in range(5):
        step = h * np.eye(5)[k]
        difference = (sampson(*moved(R, t, step), rays) - sampson(*moved(R, t, -step), rays)) / (2 * h)
        np.testing.assert_allclose(J[:, k], difference, rtol=1e-6, atol=1e-4)


def test_the_direction_s_basis_is_perpendicular_to_it():
    for t in np.random.default_rng(0).standard_normal((20, 3)):
        t = t / np.linalg.norm(t)
        B = direction_basis(t)
        np.testing.assert_allclose(np.c_[B, t].T @ np.c_[B, t], np.eye(3), atol=1e-12)


@given(st.integers(0, 10**6), st.floats(-14, 0.5))
def test_an_increment_rotates_the_projector_and_the_baseline(seed, exponent):
    rng = np.random.default_rng(seed)
    R, t, step = Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3), rng.normal(size=5) * 10.0**exponent
    t = t / np.linalg.norm(t)
    R_moved, t_moved = moved(R, t, step)
    np.testing.assert_allclose(R_moved, Rotation.from_rotvec(step[:3]).as_matrix() @ R, atol=1e-14)
    np.testing.assert_allclose(t_moved, Rotation.from_rotvec(direction_basis(t) @ step[3:]).apply(t), atol=1e-14)


# ------------------------------------------------------------------ uncertainty


@pytest.mark.parametrize("correlated", [False, True], ids=["independent errors", "errors shared by each cell"])
def test_the_stated_covariance_is_that_of_the_errors(correlated):
    """Fifty noisy copies of one frame: squared errors, in units of the covariance, average to 5."""
    clean = view(count=1500)
    true_R, true_t = clean.T_camera_projector[:3, :3], clean.T_camera_projector[:3, 3]
    true_t = true_t / np.linalg.norm(true_t)
    distances, inside = [], []
    for k in range(50):
        frame = clean.noisy(0.25, seed=100 + k, wrong=0.02)
        if correlated:
            cell = np.floor(frame.uv_projector / 16).astype(int)
            shared = np.random.default_rng(k).standard_normal((80, 80, 2)) * 0.4
            frame = replace(frame, uv_projector=frame.uv_projector + shared[cell[:, 1] % 80, cell[:, 0] % 80])
        rays, _ = ray_pairs(*frame.arguments)
        found = fit_epipolar(true_R, true_t, rays)
        C = covariance(found, rays)
        w = Rotation.from_matrix(true_R @ found.R.T).as_rotvec()
        b = direction_basis(found.t).T @ np.cross(found.t, true_t)
        e = np.concatenate([w, b])
        distances.append(e @ np.linalg.solve(C, e))
        inside += [w @ w < np.trace(C[:3, :3]), b @ b < np.trace(C[3:, 3:])]
    assert 3.5 < np.mean(distances) < 7.0  # 5 +- 0.45 for errors that are exactly normal
    assert 0.55 < np.mean(inside) < 0.8


# ------------------------------------------------------------------ what has no relative pose


def test_too_few_correspondences_are_refused():
    frame = view(count=12)
    with pytest.raises(RelativePoseError, match=r"12 decoded pixels are too few(.|\n)*remedy: more light"):
        estimate_relative_pose(*frame.arguments)


def test_coordinates_of_another_pattern_are_refused():
    frame = view(count=1000)
    uv = np.random.default_rng(99).uniform(0, 800, frame.uv_projector.shape)
    with pytest.raises(RelativePoseError, match=r"(.|\n)*pattern file is not the one(.|\n)*remedy: check pattern"):
        estimate_relative_pose(frame.uv_camera, uv, frame.camera, frame.projector)


def test_pixels_without_a_ray_are_no_inliers_and_do_no_harm():
    frame = view("DOE", count=300)
    uv = frame.uv_projector.copy()
    uv[:20] = 5000.0  # beyond 90 degrees
    uv[20:30] = np.nan
    found = estimate_relative_pose(frame.uv_camera, uv, frame.camera, frame.projector)
    assert max(errors_deg(found.T_camera_projector, frame.T_camera_projector)) < 1e-6
    assert not found.inliers[:30].any()
    assert found.inliers[30:].all()
