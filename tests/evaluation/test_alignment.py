import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.evaluation.reference import align_poses, icp
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.meshing.mesh import Mesh

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
@given(
    count=st.integers(2, 8),
    degrees=st.floats(0, 179),
    scale=st.floats(0.2, 5.0),
    seed=st.integers(0, 1000),
)
def test_poses_moved_by_a_similarity_come_back(count: int, degrees: float, scale: float, seed: int) -> None:
    true = random_poses(count, seed)
    S = Similarity(scale, turn((0.3, -1.0, 0.7), degrees), np.array([10.0, -20.0, 5.0]))
    assert_same(align_poses(S.inverse().poses(true), true), S, 1e-9)


def test_two_devices_are_enough_because_their_orientations_count() -> None:
    true = random_poses(2, 5)
    S = known_similarity()
    assert_same(align_poses(S.inverse().poses(true), true), S, 1e-10)


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
    both = Mesh(
        np.concatenate([blob().vertices, plate]),
        np.concatenate([blob().faces, [[0, 1, 2] + np.array(len(blob().vertices))]]),
    )
    S = known_similarity()
    found = icp(IndexedMesh(both.mapped(S.inverse())).sample(6000, 0)[0], truth, Similarity.identity(), True)
    assert_same(found.S_target_source, S, 1e-6)


def test_icp_with_scale_may_not_collapse_onto_a_patch() -> None:
    flat = Mesh(np.array([[-5.0, -5, 0], [5, -5, 0], [5, 5, 0], [-5, 5, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    rng = np.random.default_rng(0)
    found = icp(rng.uniform(-1, 1, (500, 3)), IndexedMesh(flat), Similarity.identity(), True)
    assert found.S_target_source.scale >= 1 / 1.5 - 1e-12
