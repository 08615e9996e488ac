"""Aligning results with the truth, errors of poses, and references of points."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.evaluation.reference import align_poses, compare_poses, icp
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity
from sl_nerfstudio.meshing.mesh import Mesh
from tests.meshing.solids import together

from .shapes import blob, known_similarity, turn


def random_poses(count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose in poses:
        pose[:3, :3] = turn(tuple(rng.normal(size=3)), rng.uniform(0, 180))
        pose[:3, 3] = rng.normal(size=3) * 300
    return poses


def assert_same(found: Similarity, expected: Similarity, tolerance: float) -> None:
    assert found.scale == pytest.approx(expected.scale, rel=tolerance)
    np.testing.assert_allclose(found.R, expected.R, atol=tolerance)
    np.testing.assert_allclose(found.t, expected.t, atol=tolerance * 300)


@settings(max_examples=20)
@given(count=st.integers(2, 8), degrees=st.floats(0, 179), scale=st.floats(0.2, 5.0), seed=st.integers(0, 1000))
def test_poses_moved_by_a_similarity_come_back(count: int, degrees: float, scale: float, seed: int) -> None:
    true = random_poses(count, seed)
    S = Similarity(scale, turn((0.3, -1.0, 0.7), degrees), np.array([10.0, -20.0, 5.0]))
    assert_same(align_poses(S.inverse().poses(true), true), S, 1e-9)


def test_without_scale_the_map_is_rigid_about_the_centroid() -> None:
    true = random_poses(6, 1)
    scaled = true.copy()
    scaled[:, :3, 3] = 1.1 * (true[:, :3, 3] - true[:, :3, 3].mean(0)) + true[:, :3, 3].mean(0)
    assert_same(align_poses(scaled, true, with_scale=False), Similarity.identity(), 1e-10)


@pytest.mark.parametrize("with_scale", [False, True])
def test_icp_brings_a_moved_mesh_back(with_scale: bool) -> None:
    truth = IndexedMesh(blob())
    S = known_similarity()
    S = Similarity(S.scale if with_scale else 1.0, S.R, S.t)
    moved = IndexedMesh(blob().mapped(S.inverse()))
    points = moved.sample(4000, 0)[0]
    found = icp(points, truth, Similarity.identity(), with_scale)
    further = icp(points, truth, found.S_target_source, with_scale)  # from where it ended nothing moves any more
    np.testing.assert_allclose(further.S_target_source.matrix(), found.S_target_source.matrix(), atol=1e-6)
    assert_same(found.S_target_source, S, 1e-6)
    assert found.residual < 1e-6


def test_icp_ignores_invented_surface() -> None:
    truth = IndexedMesh(blob())
    plate = np.array([[-1.0, -1.0, 2.0], [1.0, -1.0, 2.0], [0.0, 1.0, 2.0]])
    both = together(blob(), Mesh(plate, np.array([[0, 1, 2]])))
    S = known_similarity()
    found = icp(IndexedMesh(both.mapped(S.inverse())).sample(6000, 0)[0], truth, Similarity.identity(), True)
    assert_same(found.S_target_source, S, 1e-6)


def test_icp_with_scale_may_not_collapse_onto_a_patch() -> None:
    flat = Mesh(np.array([[-5.0, -5, 0], [5, -5, 0], [5, 5, 0], [-5, 5, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    rng = np.random.default_rng(0)
    found = icp(rng.uniform(-1, 1, (500, 3)), IndexedMesh(flat), Similarity.identity(), True)
    assert found.S_target_source.scale >= 1 / 1.5 - 1e-12


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
    bad[7, :3, :3] = turn((0, 1, 0), 2.0) @ bad[7, :3, :3]
    bad[7, :3, 3] += [3.0, 4.0, 0.0]
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
