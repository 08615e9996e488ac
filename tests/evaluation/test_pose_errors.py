import numpy as np
import pytest

from sl_nerfstudio.evaluation.reference import compare_poses
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity

from .shapes import turn
from .test_alignment import random_poses


def moved(T: np.ndarray, offset: np.ndarray, R: np.ndarray) -> np.ndarray:
    out = T.copy()
    out[:, :3, 3] += offset
    out[:, :3, :3] = R @ T[:, :3, :3]
    return out


def test_the_gauge_is_not_an_error_and_scale_is_reported_separately() -> None:
    camera, projector = random_poses(5, 0), random_poses(5, 1)
    S = Similarity(1.02, turn((1, 1, 0), 40.0), np.array([100.0, 0.0, -50.0]))
    errors = compare_poses(DevicePoses(camera, projector).mapped(S), DevicePoses(camera, projector))
    for device in (errors.camera, errors.projector, errors.relative):
        assert device.translation_rmse < 1e-9
        assert device.rotation_rmse_deg < 1e-6
    assert errors.scale_error == pytest.approx(0.02, rel=1e-9)


def test_one_bad_frame_among_many_shows_its_own_error() -> None:
    camera, projector = random_poses(200, 0), random_poses(200, 1)
    bad = camera.copy()
    bad[7] = moved(camera[7:8], np.array([3.0, 4.0, 0.0]), turn((0, 1, 0), 2.0))[0]
    errors = compare_poses(DevicePoses(bad, projector), DevicePoses(camera, projector))
    assert errors.camera.translation[7] == pytest.approx(5.0, rel=0.02)
    assert errors.camera.rotation_deg[7] == pytest.approx(2.0, rel=0.02)
    assert np.delete(errors.camera.translation, 7).max() < 0.1
    assert errors.projector.translation_rmse < 0.1
    assert errors.camera.translation_rmse == pytest.approx(np.sqrt((errors.camera.translation**2).mean()))
    assert errors.relative.rotation_deg[7] == pytest.approx(2.0, rel=1e-6)


def test_a_shift_common_to_all_projectors_is_a_relative_error() -> None:
    camera, projector = random_poses(50, 0), random_poses(50, 1)
    shifted = projector.copy()
    shifted[:, :3, 3] += [1.0, 0.0, 0.0]
    errors = compare_poses(DevicePoses(camera, shifted), DevicePoses(camera, projector))
    np.testing.assert_allclose(errors.relative.translation, 1.0, rtol=0.01)
    assert errors.camera.translation_rmse == pytest.approx(0.5, rel=0.05)  # the common map takes half of it
