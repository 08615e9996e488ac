"""Rough camera poses as a start: baselines, and a common centre."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sl_nerfstudio.registration.settings import StartSettings
from sl_nerfstudio.registration.surfaces import build_surface_map
from sl_nerfstudio.registration.view_graph import starting_similarities, with_common_centre
from tests.bundle_adjustment.analytic import rig_of
from tests.registration.analytic_clouds import clouds_of

SIZE, FRAMES = 60, 6
RIG = rig_of(FRAMES, SIZE)
LENGTH = RIG.T_camera_projector[:, :3, 3].norm(dim=-1).numpy()
POSES = RIG.T_world_camera.numpy()
MAPS = [build_surface_map(c) for c in clouds_of(RIG, SIZE)]


@settings(max_examples=20)
@given(st.integers(0, 10**6), st.floats(0.01, 100))
def test_baselines_do_not_depend_on_axes_and_unit(seed, unit):
    reference = starting_similarities(POSES, MAPS)
    rng = np.random.default_rng(seed)
    T = POSES.copy()
    T[:, :3, 3] *= unit
    world = np.eye(4)
    world[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    world[:3, 3] = unit * rng.normal(size=3)
    T = world @ T
    found = starting_similarities(T, MAPS)
    for S, pose, same in zip(found, T, reference, strict=True):
        np.testing.assert_array_equal(S.R, pose[:3, :3])
        np.testing.assert_array_equal(S.t, pose[:3, 3])
        assert S.scale == pytest.approx(unit * same.scale, rel=1e-9)


def test_true_poses_give_about_the_true_baselines():
    """Centroids of the visible parts differ, so lengths are only about right."""
    found = [S.scale for S in starting_similarities(POSES, MAPS)]
    np.testing.assert_allclose(found, LENGTH, rtol=0.25)


def test_frames_without_a_pose_have_no_start():
    T = POSES.copy()
    T[2] = np.nan
    T[4, 0, 0] = np.nan
    found = starting_similarities(T, MAPS)
    assert [S is None for S in found] == [False, False, True, False, True, False]
    assert [S is None for S in with_common_centre(found, MAPS)] == [False, False, True, False, True, False]
    none = starting_similarities(np.full_like(POSES, np.nan), MAPS)
    assert none == [None] * FRAMES
    assert with_common_centre(none, MAPS) == [None] * FRAMES


def test_a_camera_that_looks_away_gets_the_distance_of_the_others():
    T = POSES.copy()
    T[1, :3, :3] = T[1, :3, :3] @ np.diag([1.0, -1, -1])  # the object is behind it
    found = starting_similarities(T, MAPS, StartSettings(least_distance=0.2))
    distances = [S.scale * np.linalg.norm(m.centroid) for S, m in zip(found, MAPS, strict=True)]
    assert distances[1] == pytest.approx(np.median(np.delete(distances, 1)), rel=0.2)
    assert min(distances) > 0


@settings(max_examples=20)
@given(st.integers(0, 10**6))
def test_all_frames_look_at_one_centre_and_keep_their_rotations(seed):
    rng = np.random.default_rng(seed)
    T = POSES.copy()
    for k in range(FRAMES):
        turn = Rotation.from_rotvec(rng.normal(0, np.radians(8), 3)).as_matrix()
        T[k, :3, :3] = T[k, :3, :3] @ turn
    rough = starting_similarities(T, MAPS)
    found = with_common_centre(rough, MAPS)
    centres = np.array([S.points(m.views[0].centre[None])[0] for S, m in zip(found, MAPS, strict=True)])
    np.testing.assert_allclose(centres, np.tile(centres[0], (FRAMES, 1)), atol=1e-9)
    before = np.array([S.points(m.views[0].centre[None])[0] for S, m in zip(rough, MAPS, strict=True)])
    np.testing.assert_allclose(centres[0], np.median(before, axis=0), atol=1e-9)
    for S, start in zip(found, rough, strict=True):
        np.testing.assert_array_equal(S.R, start.R)
        assert S.scale == start.scale
