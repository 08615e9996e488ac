"""Ranked solutions: the true pose wins over the twin of a table, and what cannot be told apart is kept."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sl_nerfstudio.relative_pose.candidates import in_front, plane_starts, ranked, relative_pose_candidates
from sl_nerfstudio.relative_pose.epipolar import (
    RELATIVE_POSE_DEFAULTS,
    RayPairs,
    distinct,
    fit_epipolar,
    ray_pairs,
    sampson,
)
from sl_nerfstudio.relative_pose.estimation import RelativePose, estimate_relative_pose
from tests.relative_pose.table_views import DISTANCE, NORMAL, table_view, twin_of
from tests.relative_pose.two_views import PROJECTORS, View, errors_deg, view

EXACT = 1e-6


def rays_of(frame: View) -> RayPairs:
    return ray_pairs(*frame.arguments)[0]


def nearest_deg(pose: RelativePose, T: np.ndarray) -> float:
    """The smallest error among a frame's solutions, the larger of rotation and direction."""
    return min(max(errors_deg(p.T_camera_projector, T)) for p in (pose, *pose.alternatives))


# ------------------------------------------------------------------ a table and an object


@settings(max_examples=8)
@given(
    share=st.floats(0.6, 0.9),
    seed=st.integers(0, 10**6),
    table_px=st.floats(0.1, 0.4),
    ratio=st.floats(0.5, 3.0),
    wrong=st.floats(0, 0.1),
    bearing=st.floats(0, 2 * np.pi),
)
def test_the_true_pose_wins_where_a_table_fills_the_view(share, seed, table_px, ratio, wrong, bearing):
    """Also where the object is three times as noisy as the table: it still tells the pose from the table's twin."""
    offset = (np.cos(bearing), np.sin(bearing), 0.1)
    scene = table_view(share, offset=offset, count=3000, seed=seed)
    frame = scene.noisy(table_px, ratio * table_px, seed, wrong)
    found = estimate_relative_pose(*frame.arguments, seed=seed)
    assert max(errors_deg(found.T_camera_projector, frame.T_camera_projector)) < 1


@pytest.mark.parametrize("seed", range(3))
def test_nine_tenths_of_table_and_a_noisy_object_with_wrong_cells(seed):
    scene = table_view(0.9, count=16000, seed=seed)
    frame = scene.noisy(0.15, 0.8, seed, wrong=0.1)
    found = estimate_relative_pose(*frame.arguments, seed=seed)
    assert max(errors_deg(found.T_camera_projector, frame.T_camera_projector)) < 1
    twin = twin_of(frame.T_camera_projector)
    assert max(errors_deg(found.T_camera_projector, twin)) > 5
    # No decoded pixel of the object is thrown out because the table is sharper.
    assert found.inliers[scene.on_object].mean() > 0.8


@pytest.mark.parametrize("projector", sorted(PROJECTORS))
@pytest.mark.parametrize("share", [0.6, 0.9])
def test_exact_coordinates_of_a_table_with_an_object_give_the_exact_pose(projector, share):
    frame = table_view(share, projector, count=800).view
    found = estimate_relative_pose(*frame.arguments)
    assert max(errors_deg(found.T_camera_projector, frame.T_camera_projector)) < EXACT
    assert found.inliers.all() and found.alternatives == ()
    assert found.explained == pytest.approx(1, abs=1e-6)


def test_the_noise_of_each_part_of_the_frame_is_its_own():
    scene = table_view(0.8, count=8000)
    found = estimate_relative_pose(*scene.noisy(0.15, 0.45, 0).arguments)
    assert np.median(found.noise_px[~scene.on_object]) == pytest.approx(0.15, rel=0.25)
    assert np.median(found.noise_px[scene.on_object]) == pytest.approx(0.45, rel=0.25)
    assert found.inliers.mean() > 0.97


# ------------------------------------------------------------------ a plane alone


@settings(max_examples=3)
@given(st.sampled_from(sorted(PROJECTORS)), st.integers(0, 10**6), st.floats(4.6, 4.8), st.floats(0.02, 0.4))
def test_a_plane_has_the_true_pose_and_its_twin(projector, seed, bearing, noise):
    """The projector is below the camera, where the twin has all of the table in front of both devices."""
    scene = table_view(1.0, projector, (np.cos(bearing), np.sin(bearing), 0.1), 1500, seed)
    frame, true = scene.noisy(noise, noise, seed), scene.view.T_camera_projector
    twin = twin_of(true)
    assert in_front(twin[:3, :3], twin[:3, 3], rays_of(scene.view)).mean() > 0.99
    found = estimate_relative_pose(*frame.arguments, seed=seed)
    assert len(found.alternatives) == 1
    assert nearest_deg(found, true) < 0.1 + 2 * noise
    assert nearest_deg(found, twin) < 0.1 + 2 * noise
    for pose in (found, *found.alternatives):
        assert pose.explained > found.explained - 0.05
        assert (np.linalg.eigvalsh(pose.covariance) > 0).all()
        assert pose.inliers.mean() > 0.95


@pytest.mark.parametrize("seed", range(2))
def test_a_plane_of_which_the_twin_would_have_a_part_behind_it_has_one_pose(seed):
    """Where five per cent of the rays would meet behind a device, these tell the twin from the truth."""
    scene = table_view(1.0, offset=(0.7, 0.72, 0.1), count=3000, seed=seed)
    twin = twin_of(scene.view.T_camera_projector)
    assert 0.9 < in_front(twin[:3, :3], twin[:3, 3], rays_of(scene.view)).mean() < 0.96
    found = estimate_relative_pose(*scene.noisy(0.2, 0.2, seed).arguments, seed=seed)
    assert max(errors_deg(found.T_camera_projector, scene.view.T_camera_projector)) < 0.5
    assert found.alternatives == ()


def test_the_twin_explains_a_plane_exactly_and_an_object_on_it_not():
    scene = table_view(0.7, count=1000)
    T = twin_of(scene.view.T_camera_projector)
    r = np.abs(sampson(T[:3, :3], T[:3, 3], rays_of(scene.view)))
    assert r[~scene.on_object].max() < 1e-6
    assert np.median(r[scene.on_object]) > 2
    p = scene.view.p_camera[~scene.on_object]
    np.testing.assert_allclose(p @ NORMAL, -DISTANCE * NORMAL[2])


@pytest.mark.parametrize("projector", sorted(PROJECTORS))
def test_starts_from_a_plane_are_its_two_poses(projector):
    frame = table_view(1.0, projector, count=400).view
    starts = plane_starts(rays_of(frame))
    for T in (frame.T_camera_projector, twin_of(frame.T_camera_projector)):
        errors = []
        for R, t in starts:
            own = np.eye(4)
            own[:3, :3], own[:3, 3] = R, t
            errors.append(max(errors_deg(own, T)))
            assert np.linalg.det(R) == pytest.approx(1) and np.linalg.norm(t) == pytest.approx(1)
        assert min(errors) < 1e-3


def test_few_rays_and_a_rotation_alone_have_no_start_from_a_plane():
    rays = rays_of(table_view(1.0, count=400).view)
    fewest = RELATIVE_POSE_DEFAULTS.plane.fewest
    assert plane_starts(rays.chosen(np.arange(fewest - 1))) == []
    assert plane_starts(rays.chosen(np.arange(fewest))) != []
    still = rays_of(table_view(1.0, offset=(0.0, 0.0, 1e-9), count=400).view)
    assert plane_starts(still) == []


# ------------------------------------------------------------------ ranking


@settings(max_examples=4)
@given(st.floats(0, 0.04), st.integers(0, 10**6), st.floats(0.1, 0.5))
def test_alternatives_are_never_close_to_each_other(relief, seed, noise):
    frame = view(relief=relief, count=1500, seed=seed).noisy(noise, seed=seed, wrong=0.05)
    found = estimate_relative_pose(*frame.arguments, seed=seed)
    every = [(p.T_camera_projector[:3, :3], p.T_camera_projector[:3, 3]) for p in (found, *found.alternatives)]
    assert len(every) <= RELATIVE_POSE_DEFAULTS.candidates.most
    for a, b in combinations(every, 2):
        assert distinct(a, b, RELATIVE_POSE_DEFAULTS.solutions)
    explained = [p.explained for p in (found, *found.alternatives)]
    assert explained == sorted(explained, reverse=True)
    assert all(p.alternatives == () for p in found.alternatives)


@settings(max_examples=10)
@given(st.integers(0, 10**6))
def test_the_ranking_does_not_depend_on_the_order_of_points_or_solutions(seed):
    frame = table_view(0.8, count=600, seed=1).noisy(0.2, 0.4, 1, wrong=0.05)
    rays, true = rays_of(frame), frame.T_camera_projector
    twin = twin_of(true)
    fits = [fit_epipolar(T[:3, :3], T[:3, 3] / np.linalg.norm(T[:3, 3]), rays) for T in (true, twin)]
    shuffled = rays.chosen(np.random.default_rng(seed).permutation(len(rays)))
    first = ranked(fits, rays, RELATIVE_POSE_DEFAULTS)
    for order, some in ((fits, shuffled), (fits[::-1], rays), (fits[::-1], shuffled)):
        again = ranked(order, some, RELATIVE_POSE_DEFAULTS)
        assert [c.fit is d.fit for c, d in zip(again, first, strict=True)] == [True, True]
        assert [c.rivals_best for c in again] == [c.rivals_best for c in first] == [True, False]
        np.testing.assert_allclose([c.explained for c in again], [c.explained for c in first])
    assert first[0].fit is fits[0]


def test_no_solution_ranks_to_none():
    assert ranked([], rays_of(view(count=10)), RELATIVE_POSE_DEFAULTS) == []


@settings(max_examples=4)
@given(st.integers(0, 10**6), st.sampled_from(sorted(PROJECTORS)))
def test_of_exact_rays_the_best_candidate_is_the_true_pose(seed, projector):
    frame = view(projector, count=300, seed=seed)
    best, *others = relative_pose_candidates(rays_of(frame), np.random.default_rng(seed))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = best.fit.R, best.fit.t
    assert max(errors_deg(T, frame.T_camera_projector)) < 1e-4
    assert best.explained == pytest.approx(1, abs=1e-6) and best.rivals_best
    assert not any(c.rivals_best for c in others)


@settings(max_examples=5)
@given(st.integers(0, 10**6), st.sampled_from(sorted(PROJECTORS)))
def test_a_third_of_wrong_coordinates_does_not_hide_the_true_pose(seed, projector):
    frame = view(projector, count=1500, seed=seed).noisy(0.3, seed=seed, wrong=0.3)
    best = relative_pose_candidates(rays_of(frame), np.random.default_rng(seed))[0]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = best.fit.R, best.fit.t
    assert max(errors_deg(T, frame.T_camera_projector)) < 1
    assert 0.5 < best.explained < 0.8


def test_what_a_solution_explains_is_weighed_by_how_well_it_fits():
    """Right in front with residuals r at width w: 1 - x / (1 + x), x = (r / w)^2; behind a device: nothing."""
    frame = view(count=500).noisy(0.3, seed=0, wrong=0.3)
    rays, T = rays_of(frame), frame.T_camera_projector
    fit = fit_epipolar(T[:3, :3], T[:3, 3] / np.linalg.norm(T[:3, 3]), rays)
    (only,) = ranked([fit], rays, RELATIVE_POSE_DEFAULTS)
    x = (fit.residual / (RELATIVE_POSE_DEFAULTS.fit.kernel_sigmas * fit.noise_px)) ** 2
    assert only.explained <= np.mean(1 / (1 + x)) + 1e-9
    assert only.explained == pytest.approx(np.mean(1 / (1 + x)), abs=0.02)


def test_random_coordinates_are_explained_by_nothing():
    frame = view(count=1000)
    rng = np.random.default_rng(99)
    uv = rng.uniform(0, 800, frame.uv_projector.shape)
    rays, _ = ray_pairs(frame.uv_camera, uv, frame.camera, frame.projector)
    assert all(c.fit.noise_px > 100 for c in relative_pose_candidates(rays, rng))
