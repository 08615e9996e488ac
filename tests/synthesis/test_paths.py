"""Paths: all around, smooth, at the right distances, and of the kind asked for."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sl_nerfstudio.synthesis.devices import make_paths
from sl_nerfstudio.synthesis.scenes import cone_and_cylinder

_SCENE = cone_and_cylinder()
_SEEDS = range(8)


def _paths(kind, seed, frames=22):
    return make_paths(_SCENE, frames, kind, np.random.default_rng(seed))


def _relative(poses):
    return np.linalg.inv(poses.T_world_camera) @ poses.T_world_projector


def _out(T):
    return T[:, :3, 3] - _SCENE.centre


@pytest.mark.parametrize("seed", _SEEDS)
@pytest.mark.parametrize("frames", [22, 57])
def test_a_hand_held_camera_goes_all_around_the_upper_half(seed, frames):
    poses = _paths("hand-held", seed, frames)
    out = _out(poses.T_world_camera)
    distance = np.linalg.norm(out, axis=1)
    assert distance.min() > 4 * 80 and distance.max() < 5 * 80
    elevation = np.degrees(np.arcsin(out[:, 2] / distance))
    assert elevation.min() > 20 and elevation.max() < 70 and np.ptp(elevation) > 15
    azimuth = np.sort(np.degrees(np.arctan2(out[:, 1], out[:, 0])))
    assert np.diff(np.concatenate([azimuth, azimuth[:1] + 360])).max() < 40
    step = np.degrees(np.arccos((out[1:] * out[:-1]).sum(1) / distance[1:] / distance[:-1]))
    assert step.min() > 1 and step.max() < 35


@pytest.mark.parametrize("seed", _SEEDS)
def test_the_projector_is_beside_the_camera_and_never_twice_in_the_same_place(seed):
    poses = _paths("hand-held", seed)
    relative = _relative(poses)
    baseline = np.linalg.norm(relative[:, :3, 3], axis=1)
    assert baseline.min() > 59.9 and baseline.max() < 120.1 and np.ptp(baseline) > 15
    distance = np.linalg.norm(_out(poses.T_world_projector), axis=1)
    assert distance.min() > 4 * 80 and distance.max() < 5 * 80
    for i in range(len(relative)):
        for j in range(i):
            turn = np.degrees(Rotation.from_matrix(relative[i, :3, :3].T @ relative[j, :3, :3]).magnitude())
            assert turn > 0.2 or np.linalg.norm(relative[i, :3, 3] - relative[j, :3, 3]) > 1.0


@pytest.mark.parametrize("kind", ["hand-held", "rigid-rig", "static-projector"])
@pytest.mark.parametrize("seed", _SEEDS)
def test_both_devices_look_at_the_object_and_poses_are_rigid(kind, seed):
    poses = _paths(kind, seed)
    for T in (poses.T_world_camera, poses.T_world_projector):
        np.testing.assert_allclose(np.linalg.det(T[:, :3, :3]), 1, atol=1e-12)
        np.testing.assert_allclose(
            T[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1), np.tile(np.eye(3), (22, 1, 1)), atol=1e-12
        )
        out = _out(T)
        cosine = (T[:, :3, 2] * out).sum(1) / np.linalg.norm(out, axis=1)
        assert cosine.min() > np.cos(np.radians(4))
        assert (out[:, 2] > 0).all()


@pytest.mark.parametrize("seed", _SEEDS)
def test_a_rigid_rig_is_rigid(seed):
    relative = _relative(_paths("rigid-rig", seed))
    np.testing.assert_allclose(relative, np.tile(relative[0], (22, 1, 1)), atol=1e-10)
    assert 60 < np.linalg.norm(relative[0, :3, 3]) < 120


@pytest.mark.parametrize("seed", _SEEDS)
def test_a_static_projector_stands_still_and_the_camera_does_not(seed):
    poses = _paths("static-projector", seed)
    assert (poses.T_world_projector == poses.T_world_projector[0]).all()
    baseline = np.linalg.norm(_relative(poses)[:, :3, 3], axis=1)
    assert baseline.min() > 60 and baseline.max() < 300
    assert np.linalg.norm(np.diff(poses.T_world_camera[:, :3, 3], axis=0), axis=1).min() > 5


def test_neighbouring_frames_move_smoothly():
    poses = _paths("hand-held", 3, frames=60)
    for T in (poses.T_world_camera, poses.T_world_projector):
        position = T[:, :3, 3]
        bend = np.linalg.norm(position[2:] - 2 * position[1:-1] + position[:-2], axis=1)
        assert bend.max() < 0.6 * np.linalg.norm(np.diff(position, axis=0), axis=1).max()
