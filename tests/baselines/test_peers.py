"""Peers are compared by errors that a perfect result has none of, and a shifted one exactly as shifted."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.baselines.colmap import camera_pose
from benchmarks.baselines.poisson import poisson
from benchmarks.peers import camera_errors, without_pattern
from sl_nerfstudio.evaluation.evaluate import score_alignments
from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.evaluation.reference import mesh_reference
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.meshing.files import read_mesh
from sl_nerfstudio.scan import read_ground_truth, read_scan
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.synthesise import make_setup, synthesise

SIZE = 40.0


def around(count: int = 9) -> dict[str, np.ndarray]:
    """Cameras around an object."""
    rng = np.random.default_rng(3)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.random(count, random_state=4).as_matrix()
    T[:, :3, 3] = 3 * SIZE * rng.standard_normal((count, 3))
    return {f"frame_{k}": one for k, one in enumerate(T)}


def elsewhere(cameras: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The same cameras in other axes and another unit."""
    S = Similarity(0.37, Rotation.random(random_state=8).as_matrix(), np.array([5.0, -7.0, 2.0]))
    return {name: S.poses(T) for name, T in cameras.items()}


def test_the_gauge_is_no_error_and_a_shifted_camera_is_off_by_its_shift_and_tilts_no_other() -> None:
    true = around()
    perfect = camera_errors(elsewhere(true), true, SIZE)
    assert perfect.right == 9 and perfect.deg.max() < 1e-5 and perfect.centre.max() < 1e-9
    moved = {name: T.copy() for name, T in true.items()}
    moved["frame_4"][:3, 3] += [0.0, 0.5 * SIZE, 0.0]
    moved["frame_7"][:3, :3] = moved["frame_7"][:3, :3] @ Rotation.from_euler("x", 20, degrees=True).as_matrix()
    found = camera_errors(elsewhere(moved), true, SIZE)
    assert found.right == 7
    np.testing.assert_allclose(found.centre, np.where(np.arange(9) == 4, 0.5, 0.0), atol=1e-6)
    np.testing.assert_allclose(found.deg, np.where(np.arange(9) == 7, 20.0, 0.0), atol=1e-4)
    assert camera_errors({}, true, SIZE).right == 0


def test_a_camera_of_colmap_looks_along_its_own_z_axis() -> None:
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = Rotation.random(random_state=5).as_matrix()
    T_world_camera[:3, 3] = 1.0, 2.0, 3.0
    ours = camera_pose(np.linalg.inv(T_world_camera)[:3])
    np.testing.assert_allclose(ours[:3, 3], T_world_camera[:3, 3], atol=1e-12)
    np.testing.assert_allclose(-ours[:3, 2], T_world_camera[:3, 2], atol=1e-12)
    np.testing.assert_allclose(ours[:3, 0], T_world_camera[:3, 0], atol=1e-12)


@pytest.mark.parametrize("appearance", [pytest.param("plain", marks=pytest.mark.slow), "realistic"])
def test_without_the_pattern_the_light_is_constant_or_does_not_depend_on_the_projector(appearance) -> None:
    setup = make_setup(SynthConfig(scene="head", appearance=appearance, frames=3, resolution=40, images_only=True))

    def image(light, projector: int) -> np.ndarray:
        T = setup.truth.T_world_projector[[projector] * 3]
        lit = without_pattern(replace(setup, truth=replace(setup.truth, T_world_projector=T)), light)
        if lit.photography is None:
            return lit.render(0, 1).radiance
        return lit.photograph(0, 1, lit.photography, 0).image.astype(np.float64)

    np.testing.assert_array_equal(image("room", 0), image("room", 2))
    assert np.abs(image("constant", 0) - image("constant", 2)).max() > 0
    flat = without_pattern(setup, "constant")
    assert (flat.pattern == 1).all() and (flat.truth.T_world_camera == setup.truth.T_world_camera).all()
    if flat.photography is not None:
        assert (flat.photography.look.pattern.levels == 1).all()


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Exact coordinates and poses."""
    root = tmp_path_factory.mktemp("peers") / "scan"
    synthesise(SynthConfig(frames=6, resolution=120, supersampling=1, clean=True), root)
    return root


@pytest.mark.slow
def test_poissons_surface_of_exact_points_is_the_true_one_and_goes_no_farther_than_the_points(clean: Path) -> None:
    scan = read_scan(clean)
    truth = read_ground_truth(scan)
    assert truth.mesh_path is not None and truth.poses is not None
    reference = mesh_reference(read_mesh(truth.mesh_path), scan, truth.poses, 20_000)
    surface = IndexedMesh(poisson(scan, truth.poses))
    score = score_alignments(surface, reference, truth.poses, truth.poses, samples=20_000)["none"]
    assert score.accuracy.median < 1e-3 * reference.size and score.accuracy.rmse < 0.01 * reference.size
    assert score.completeness.median < 2e-3 * reference.size
