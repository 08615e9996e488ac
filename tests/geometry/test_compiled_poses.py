"""Compiled increments of poses, against matrix exponentials and logarithms."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.lie import departures, inverse_poses, moved_poses

ANGLES = [0.0, 1e-12, 1e-8, 1e-5, 1e-2, 0.2999, 0.3, 0.3001, 1.0, 2.0, 3.0, np.pi - 1e-3, np.pi - 1e-7]
AXES = [(1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0), (1.0, -2.0, 0.5), (-0.3, 0.4, 5.0)]


def twist_of(shift, axis, angle: float) -> np.ndarray:
    return np.concatenate([shift, angle * np.array(axis) / np.linalg.norm(axis)])


def matrix_of(twist: np.ndarray) -> np.ndarray:
    """The element of the Lie algebra."""
    v, (x, y, z) = twist[:3], twist[3:]
    return np.array([[0, -z, y, v[0]], [z, 0, -x, v[1]], [-y, x, 0, v[2]], [0, 0, 0, 0]])


def some_poses(n: int, seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.random(n, random_state=seed).as_matrix(), random.normal(size=(n, 3))
    return T


@pytest.mark.parametrize("angle", ANGLES)
def test_increments_are_matrix_exponentials_and_departures_take_them_back(angle):
    twists = np.stack([twist_of((0.3, -0.8, 2.0), axis, angle) for axis in AXES])
    T, relative = some_poses(len(AXES), 1), some_poses(len(AXES), 2)
    moved, turned = np.empty_like(T), np.empty_like(T)
    moved_poses(len(T), T, twists, moved)
    for k, twist in enumerate(twists):
        assert np.allclose(moved[k], expm(matrix_of(twist)) @ T[k], rtol=0, atol=1e-14)
    moved_poses(len(T), relative, twists, turned)
    found = np.empty((len(T), 12))
    departures(len(T), T, moved, relative, turned, found)
    # beside pi the logarithm of the shift is as ill-conditioned as a tangent
    assert np.allclose(found[:, :6], twists, rtol=0, atol=1e-13 if angle < 3.1 else 1e-6)
    assert np.allclose(found[:, 6:9], turned[:, :3, 3] - relative[:, :3, 3], rtol=0, atol=1e-15)
    assert np.allclose(found[:, 9:], twists[:, 3:], rtol=0, atol=1e-13)


@given(st.integers(0, 10**6), st.integers(1, 5))
def test_departures_and_increments_are_each_others_inverse(seed, n):
    then, now, first, second = (some_poses(n, seed + k) for k in range(4))
    found, back = np.empty((n, 12)), np.empty_like(then)
    departures(n, then, now, first, second, found)
    moved_poses(n, then, np.ascontiguousarray(found[:, :6]), back)
    assert np.allclose(back, now, rtol=0, atol=1e-11)
    inverse_poses(n, then, back)
    assert np.allclose(back, np.linalg.inv(then), rtol=0, atol=1e-13)
    between = second[:, :3, :3] @ first[:, :3, :3].transpose(0, 2, 1)
    assert np.allclose(Rotation.from_rotvec(found[:, 9:]).as_matrix(), between, rtol=0, atol=1e-13)
