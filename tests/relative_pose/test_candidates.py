"""First solutions and their ranking: the true pose wins over a table's twin, and what cannot be told apart is kept."""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.devices import Intrinsics, project, unproject
from sl_nerfstudio.relative_pose.candidates import (
    FEWEST_IN_PLANE,
    essential_matrices,
    five_point_starts,
    in_front,
    plane_starts,
    poses_of,
    ranked,
    relative_pose_candidates,
)
from sl_nerfstudio.relative_pose.epipolar import KERNEL_SIGMAS, RayPairs, fit_epipolar, ray_pairs
from sl_nerfstudio.relative_pose.estimation import (
    MOST_SOLUTIONS,
    RelativePose,
    estimate_relative_pose,
)
from tests.relative_pose.two_views import CAMERA, PROJECTORS, View, errors_deg, matrix_of, pose_of, true_pose, view

# A table that fills most of the view, and a bumpy object on it.

NORMAL = np.array([0.0, np.sin(np.radians(50)), np.cos(np.radians(50))])  # the camera looks down at 50 degrees
DISTANCE = 4.5  # of the table from the camera, along its line of sight


@dataclass(frozen=True)
class TableView:
    """A frame and which of its correspondences lie on the object."""

    view: View
    on_object: ndarray

    def noisy(self, table_px: float, object_px: float, seed: int, wrong: float = 0.0) -> View:
        """Noise of each part, and wrong coordinates on both."""
        rng = np.random.default_rng(seed)
        sigma = np.where(self.on_object, object_px, table_px)[:, None]
        uv = self.view.uv_projector + sigma * rng.standard_normal(self.view.uv_projector.shape)
        return replace(self.view, uv_projector=uv).noisy(0.0, seed + 1, wrong)


def table_view(
    share: float,
    projector: str = "pinhole",
    offset: tuple[float, float, float] = (1.0, 0.25, 0.1),
    count: int = 4000,
    seed: int = 0,
    height: float = 0.5,
) -> TableView:
    """`share` of the pixels see the table, the others an object that stands up to `height` above it."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform([140, 80], [500, 400], (count, 2))
    d = unproject(Intrinsics.of(CAMERA, torch.float64), torch.from_numpy(uv)).numpy()
    s = DISTANCE * NORMAL[2] / -(d @ NORMAL)  # to the table
    p = d * s[:, None]
    off = np.linalg.norm(uv - [320, 240], axis=1)
    on_object = off < np.quantile(off, 1 - share)
    x, y = 12 * d[:, 0] + seed, 12 * d[:, 1]
    up = height * (0.6 + 0.25 * np.sin(x) * np.cos(y) + 0.15 * np.sin(2.3 * y + 0.5 * x))
    p = np.where(on_object[:, None], d * (s * (1 - up / DISTANCE))[:, None], p)
    T = pose_of(offset, (0.0, 0.0, -DISTANCE), 10.0)
    uv_projector, lit = project(
        Intrinsics.of(PROJECTORS[projector], torch.float64), torch.from_numpy((p - T[:3, 3]) @ T[:3, :3])
    )
    assert lit.all()
    return TableView(View(CAMERA, PROJECTORS[projector], T, uv, uv_projector.numpy(), p), on_object)


def twin_of(T: ndarray) -> ndarray:
    """The other pose of the projector that explains the table (Longuet-Higgins 1986), baseline one.

    Points of the plane `n . p = -D` are mapped by `H = A + (A t) n^T / D`, where A = R^T. Vectors perpendicular to n
    keep their lengths and angles under H, and so do those perpendicular to `c = t + |t|^2 n / 2D`: there H is the
    twin's rotation. What remains of H along c is its translation.
    """
    A, t, D = T[:3, :3].T, T[:3, 3], DISTANCE * NORMAL[2]
    H = A + np.outer(A @ t, NORMAL) / D
    c = t + (t @ t) * NORMAL / (2 * D)
    c = c / np.linalg.norm(c) * np.sign(c[2])  # the plane is in front of the camera
    across = np.cross(NORMAL, c)
    across = across / np.linalg.norm(across)
    inside = np.cross(c, across)
    before = np.stack([across, inside, c], 1)
    after = np.stack([H @ across, H @ inside, np.cross(H @ across, H @ inside)], 1)
    A_twin = after @ before.T
    t_twin = A_twin.T @ (H - A_twin) @ c
    twin = np.eye(4)
    twin[:3, :3], twin[:3, 3] = A_twin.T, t_twin / np.linalg.norm(t_twin)
    return twin


def rays_of(frame: View) -> RayPairs:
    return ray_pairs(*frame.arguments)[0]


def error_deg(pose, T) -> float:
    """The larger error of rotation and direction, of a RelativePose or a pair (R, t)."""
    return max(errors_deg(pose.T_camera_projector if isinstance(pose, RelativePose) else matrix_of(*pose), T))


def estimate(frame: View, seed: int = 0) -> RelativePose:
    return estimate_relative_pose(*frame.arguments, seed=seed)


# ------------------------------------------------------------------ samples of five, planes


def test_the_essential_matrix_of_five_exact_pairs_is_among_the_solutions():
    frame = view(count=200)
    rays, (R, t) = rays_of(frame), true_pose(frame)
    true = np.cross(t, R.T).T  # [t]x R, as d_camera . (t x R d_projector) = 0
    for seed in range(10):
        sample = rays.chosen(np.random.default_rng(seed).choice(len(rays), 5, replace=False))
        found = essential_matrices(sample)
        assert 1 <= len(found) <= 10
        for E in found:
            assert np.abs(np.einsum("ni,ij,nj->n", sample.d_camera, E, sample.d_projector)).max() < 1e-8
        unit = true / np.linalg.norm(true)
        assert min(np.linalg.norm(s * E / np.linalg.norm(E) - unit) for E in found for s in (1, -1)) < 1e-4
    (pose,) = (pose for pose in poses_of(true) if in_front(*pose, rays).all())
    assert error_deg(pose, frame.T_camera_projector) < 1e-6
    same = rays.chosen(np.zeros(5, dtype=np.int64))
    assert all(np.isfinite(E).all() for E in essential_matrices(same))


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


def test_rays_that_are_no_image_points_are_not_sampled():
    """Nine tenths of the rays run sideways, where a device has no image point."""
    rays = rays_of(view(count=300))
    d = rays.d_camera.copy()
    d[np.arange(len(rays)) % 10 > 0, 2] = 0.0
    for R, t in five_point_starts(replace(rays, d_camera=d), np.random.default_rng(0)):
        assert np.isfinite(R).all() and np.isfinite(t).all()
    d[:, 2] = 0.0
    assert five_point_starts(replace(rays, d_camera=d), np.random.default_rng(0)) == []
    assert five_point_starts(rays.chosen(np.arange(4)), np.random.default_rng(0)) == []


@pytest.mark.parametrize("projector", sorted(PROJECTORS))
def test_starts_from_a_plane_are_its_two_poses(projector):
    frame = table_view(1.0, projector, count=400).view
    rays = rays_of(frame)
    starts = plane_starts(rays)
    for T in (frame.T_camera_projector, twin_of(frame.T_camera_projector)):
        assert min(error_deg(start, T) for start in starts) < 1e-3
    assert plane_starts(rays.chosen(np.arange(FEWEST_IN_PLANE - 1))) == []
    assert plane_starts(rays_of(table_view(1.0, projector, offset=(0.0, 0.0, 1e-9), count=400).view)) == []


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
    scene = table_view(share, offset=(np.cos(bearing), np.sin(bearing), 0.1), count=3000, seed=seed)
    frame = scene.noisy(table_px, ratio * table_px, seed, wrong)
    assert error_deg(estimate(frame, seed), frame.T_camera_projector) < 1


@pytest.mark.parametrize("seed", range(2))
def test_nine_tenths_of_table_and_a_noisy_object_with_wrong_cells(seed):
    scene = table_view(0.9, count=16000, seed=seed)
    frame = scene.noisy(0.15, 0.8, seed, wrong=0.1)
    found = estimate(frame, seed)
    assert error_deg(found, frame.T_camera_projector) < 1
    assert error_deg(found, twin_of(frame.T_camera_projector)) > 5
    # No decoded pixel of the object is thrown out because the table is sharper.
    assert found.inliers[scene.on_object].mean() > 0.8
    assert np.median(found.noise_px[scene.on_object]) > 2 * np.median(found.noise_px[~scene.on_object])


@pytest.mark.parametrize("projector", sorted(PROJECTORS))
def test_exact_coordinates_of_a_table_with_an_object_give_the_exact_pose(projector):
    frame = table_view(0.9, projector, count=800).view
    found = estimate(frame)
    assert error_deg(found, frame.T_camera_projector) < 1e-6
    assert found.inliers.all() and found.alternatives == ()
    assert found.explained == pytest.approx(1, abs=1e-6)


# ------------------------------------------------------------------ a plane alone


@settings(max_examples=3)
@given(st.sampled_from(sorted(PROJECTORS)), st.integers(0, 10**6), st.floats(4.6, 4.8), st.floats(0.02, 0.4))
def test_a_plane_has_the_true_pose_and_its_twin(projector, seed, bearing, noise):
    """The projector is below the camera, where the twin has all of the table in front of both devices."""
    scene = table_view(1.0, projector, (np.cos(bearing), np.sin(bearing), 0.1), 1500, seed)
    true = scene.view.T_camera_projector
    twin = twin_of(true)
    assert in_front(twin[:3, :3], twin[:3, 3], rays_of(scene.view)).mean() > 0.99
    found = estimate(scene.noisy(noise, noise, seed), seed)
    assert len(found.alternatives) == 1
    for pose in (found, *found.alternatives):
        assert min(error_deg(pose, true), error_deg(pose, twin)) < 0.1 + 2 * noise
        assert pose.explained > found.explained - 0.05
        assert (np.linalg.eigvalsh(pose.covariance) > 0).all()
        assert pose.inliers.mean() > 0.95


@pytest.mark.parametrize("seed", range(2))
def test_a_plane_of_which_the_twin_would_have_a_part_behind_it_has_one_pose(seed):
    """Where five per cent of the rays would meet behind a device, these tell the twin from the truth."""
    scene = table_view(1.0, offset=(0.7, 0.72, 0.1), count=3000, seed=seed)
    twin = twin_of(scene.view.T_camera_projector)
    assert 0.9 < in_front(twin[:3, :3], twin[:3, 3], rays_of(scene.view)).mean() < 0.96
    found = estimate(scene.noisy(0.2, 0.2, seed), seed)
    assert error_deg(found, scene.view.T_camera_projector) < 0.5
    assert found.alternatives == ()


# ------------------------------------------------------------------ ranking


@settings(max_examples=4)
@given(st.floats(0, 0.04), st.integers(0, 10**6), st.floats(0.1, 0.5))
def test_alternatives_are_never_close_to_each_other(relief, seed, noise):
    found = estimate(view(relief=relief, count=1500, seed=seed).noisy(noise, seed=seed, wrong=0.05), seed)
    every = (found, *found.alternatives)
    assert len(every) <= MOST_SOLUTIONS
    for a, b in combinations(every, 2):
        turn, swing = errors_deg(a.T_camera_projector, b.T_camera_projector)
        assert turn > 2 or swing > 5.7
    explained = [p.explained for p in every]
    assert explained == sorted(explained, reverse=True)


@settings(max_examples=10)
@given(st.integers(0, 10**6))
def test_the_ranking_does_not_depend_on_the_order_of_points_or_solutions(seed):
    frame = table_view(0.8, count=600, seed=1).noisy(0.2, 0.4, 1, wrong=0.05)
    rays, true = rays_of(frame), frame.T_camera_projector
    fits = [fit_epipolar(T[:3, :3], T[:3, 3] / np.linalg.norm(T[:3, 3]), rays) for T in (true, twin_of(true))]
    shuffled = rays.chosen(np.random.default_rng(seed).permutation(len(rays)))
    first = ranked(fits, rays)
    assert first[0].fit is fits[0] and [c.rivals_best for c in first] == [True, False]
    for order, some in ((fits, shuffled), (fits[::-1], rays), (fits[::-1], shuffled)):
        again = ranked(order, some)
        assert all(c.fit is d.fit and c.rivals_best == d.rivals_best for c, d in zip(again, first, strict=True))
        np.testing.assert_allclose([c.explained for c in again], [c.explained for c in first])
    assert ranked([], rays) == []


@settings(max_examples=5)
@given(st.integers(0, 10**6), st.sampled_from(sorted(PROJECTORS)))
def test_a_third_of_wrong_coordinates_does_not_hide_the_true_pose(seed, projector):
    frame = view(projector, count=1500, seed=seed).noisy(0.3, seed=seed, wrong=0.3)
    best = relative_pose_candidates(rays_of(frame), np.random.default_rng(seed))[0]
    assert error_deg((best.fit.R, best.fit.t), frame.T_camera_projector) < 1
    assert 0.5 < best.explained < 0.8


def test_what_a_solution_explains_is_weighed_by_how_well_it_fits():
    """Right in front with residuals r at width w: 1 - x / (1 + x), x = (r / w)^2; behind a device: nothing."""
    frame = view(count=500).noisy(0.3, seed=0, wrong=0.3)
    rays = rays_of(frame)
    fit = fit_epipolar(*true_pose(frame), rays)
    (only,) = ranked([fit], rays)
    expected = np.mean(1 / (1 + (fit.residual / (KERNEL_SIGMAS * fit.noise_px)) ** 2))
    assert expected - 0.02 < only.explained <= expected + 1e-9
