"""The outline of the object in a frame."""

import numpy as np

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.object_separation.planes import DecodedFrame
from sl_nerfstudio.object_separation.separate import silhouette

CAMERA = Device(120, 100, 200.0, 200.0, 60.0, 50.0)


def _frame(stride=1):
    shape = (100 // stride, 120 // stride)
    return DecodedFrame(CAMERA, CAMERA, np.eye(4), np.eye(4), np.full((*shape, 2), np.nan, np.float32),
                        np.ones(shape, bool), stride)  # fmt: skip


def test_a_sparse_disc_is_a_full_disc_and_what_is_behind_the_camera_is_nowhere():
    rng = np.random.default_rng(0)
    angle, r = rng.uniform(0, 2 * np.pi, 3000), 10 * np.sqrt(rng.uniform(0, 1, 3000))
    disc = np.column_stack([r * np.cos(angle), r * np.sin(angle), np.full(3000, -100.0)])
    x, y = np.meshgrid(np.arange(120) + 0.5 - 60, np.arange(100) + 0.5 - 50)
    inside = np.hypot(x, y) < 20  # 10 units at a distance of 100 and a focal length of 200
    found = silhouette(_frame(), np.concatenate([disc, disc * [1, 1, -1]]), 2.0)
    assert (found & ~inside).sum() <= 0.05 * inside.sum() and (~found & inside).sum() <= 0.05 * inside.sum()
    half = silhouette(_frame(2), disc, 2.0)
    assert (half == found[::2, ::2]).mean() > 0.97


def test_without_points_there_is_no_outline():
    assert not silhouette(_frame(), np.zeros((0, 3)), 1.0).any()
    assert not silhouette(_frame(), np.array([[0.0, 0.0, 50.0]]), 1.0).any()
