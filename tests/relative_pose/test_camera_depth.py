import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.triangulation import closest_approach
from sl_nerfstudio.relative_pose.epipolar import moved
from sl_nerfstudio.relative_pose.intrinsics import camera_depth, camera_depth_by_pose


def _rays(seed: int):
    """A projector beside a camera, and rays of both to points that lie near the ones they see."""
    rng = np.random.default_rng(seed)
    R = Rotation.from_rotvec(rng.normal(0, 0.4, 3)).as_matrix()
    t = rng.normal(size=3)
    t /= np.linalg.norm(t)
    p = rng.normal(size=(40, 3)) + [0, 0, -5]
    beside = (p + rng.normal(0, 0.02, p.shape) - t) @ R
    d_camera, d_projector = (q / np.linalg.norm(q, axis=1, keepdims=True) for q in (p, beside))
    return R, t, d_camera, d_projector


@given(st.integers(0, 2**20))
def test_derivatives_are_those_of_differences(seed):
    R, t, *rays = _rays(seed)
    h = 1e-6
    slopes = [
        (camera_depth(*moved(R, t, step), *rays) - camera_depth(*moved(R, t, -step), *rays)) / (2 * h)
        for step in h * np.eye(5)
    ]
    found = camera_depth_by_pose(R, t, *rays)
    scale = np.abs(found).max(0)
    np.testing.assert_allclose(found / scale, np.stack(slopes, 1) / scale, rtol=1e-4, atol=1e-7)


def test_depth_is_where_the_rays_come_closest():
    R, t, d_camera, d_projector = _rays(3)
    depth = camera_depth(R, t, d_camera, d_projector)
    zero, d = torch.zeros(3, dtype=torch.float64), torch.from_numpy(d_camera)
    expected, _ = closest_approach(zero, d, torch.from_numpy(t), torch.from_numpy(d_projector @ R.T))
    assert depth == pytest.approx(expected.numpy(), rel=1e-12)
