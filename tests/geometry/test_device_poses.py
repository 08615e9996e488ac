"""The container of all poses: what its operations mean, for any rigid motions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from random_geometry import generator, motions, seeds

from sl_nerfstudio.geometry.lie import DevicePoses, Similarity


def poses_of(seed: int, count: int = 5) -> DevicePoses:
    source = generator(seed)
    return DevicePoses(motions((count,), source).numpy(), motions((count,), source, 2.0).numpy())


def similarity_of(seed: int, scale: float) -> Similarity:
    T = motions((), generator(seed), 1.5).numpy()
    return Similarity(scale, T[:3, :3], T[:3, 3])


scales = st.floats(0.01, 100.0)


@given(seeds)
def test_relative_poses_lead_from_each_camera_to_its_projector(seed):
    poses = poses_of(seed)
    assert len(poses) == 5
    np.testing.assert_allclose(poses.T_world_camera @ poses.T_camera_projector, poses.T_world_projector, atol=1e-12)
    np.testing.assert_allclose(poses.baseline, np.linalg.norm(poses.T_camera_projector[:, :3, 3], axis=1), atol=1e-12)
    assert np.array_equal(poses.stacked(), np.concatenate([poses.T_world_camera, poses.T_world_projector]))


@given(seeds, seeds, scales)
def test_another_world_scales_lengths_and_leaves_relative_orientations(seed, other, scale):
    poses, S = poses_of(seed), similarity_of(other, scale)
    mapped = poses.mapped(S)
    np.testing.assert_allclose(mapped.baseline, scale * poses.baseline, rtol=1e-9)
    np.testing.assert_allclose(mapped.T_camera_projector[:, :3, :3], poses.T_camera_projector[:, :3, :3], atol=1e-12)
    np.testing.assert_allclose(mapped.stacked()[:, :3, 3], S.points(poses.stacked()[:, :3, 3]), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(mapped.mapped(S.inverse()).stacked(), poses.stacked(), atol=1e-9)


@given(seeds, scales)
def test_scaling_multiplies_all_positions(seed, factor):
    poses = poses_of(seed)
    scaled = poses.mapped(Similarity.scaling(factor)).stacked()
    np.testing.assert_allclose(scaled[:, :3, 3], factor * poses.stacked()[:, :3, 3], rtol=1e-12)
    assert np.array_equal(scaled[:, :3, :3], poses.stacked()[:, :3, :3])


@pytest.mark.parametrize("frames", [[3, 1], slice(1, 4), np.array([True, False, False, True, True])])
def test_some_frames_keep_camera_and_projector_together(frames):
    poses = poses_of(0)
    some = poses[frames]
    assert np.array_equal(some.T_world_camera, poses.T_world_camera[frames])
    assert np.array_equal(some.T_world_projector, poses.T_world_projector[frames])


def test_frames_without_poses_are_nan_and_stay_so():
    poses = poses_of(0)
    poses.T_world_camera[2] = np.nan
    mapped = poses.mapped(similarity_of(1, 2.0))
    assert np.isnan(mapped.baseline).tolist() == [False, False, True, False, False]
