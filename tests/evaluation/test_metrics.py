import numpy as np
import pytest

from sl_nerfstudio.evaluation.evaluate import DistanceStats, default_f_distances, score_surface
from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.evaluation.reference import MeshReference, PointReference
from sl_nerfstudio.geometry.lie import Similarity

from .shapes import blob, known_similarity, sphere


def whole(surface: IndexedMesh) -> MeshReference:
    return MeshReference(surface, surface.sample(20_000, 9)[0], "all of it")


def test_a_sphere_that_is_larger_by_a_known_amount_has_exactly_that_distance_everywhere() -> None:
    result, truth = IndexedMesh(sphere(10.25, 200)), IndexedMesh(sphere(10.0, 200))
    score = score_surface(result, result.sample(20_000, 0)[0], whole(truth), Similarity.identity(), (0.2, 0.3))
    sagitta = 10.25 * (np.pi / 200) ** 2  # facets cut this much off, at most
    for stats in (score.accuracy, score.completeness):
        for value in (stats.mean, stats.median, stats.rmse, stats.p95):
            assert value == pytest.approx(0.25, abs=sagitta)
    assert score.chamfer == pytest.approx((score.accuracy.mean + score.completeness.mean) / 2, rel=1e-12)
    assert score.f_score == {0.2: 0.0, 0.3: 1.0}
    assert score.scale == 1.0


def test_half_of_a_truth_missing_leaves_accuracy_and_halves_recall() -> None:
    truth = sphere(10.0, 100)
    half = truth.with_faces(truth.vertices[truth.faces].mean(1)[:, 2] > 0)
    result = IndexedMesh(half)
    score = score_surface(
        result, result.sample(20_000, 0)[0], whole(IndexedMesh(truth)), Similarity.identity(), (0.01,)
    )
    assert score.accuracy.p95 < 1e-6
    assert score.completeness.p95 > 5
    assert score.f_score[0.01] == pytest.approx(2 / 3, abs=0.01)  # precision 1, recall 1/2


def test_a_mesh_moved_by_a_known_similarity_is_perfect_again_and_its_scale_is_found() -> None:
    truth, S = IndexedMesh(blob()), known_similarity()
    result = IndexedMesh(blob().mapped(S.inverse()))
    samples = result.sample(20_000, 0)[0]
    reference = whole(truth)
    found = reference.align(result, samples, Similarity.identity(), with_scale=True)
    score = score_surface(result, samples, reference, found.S_target_source, (1e-3,))
    assert score.scale == pytest.approx(S.scale, rel=1e-6)
    assert score.accuracy.p95 < 1e-6 and score.completeness.p95 < 1e-6
    assert score.f_score[1e-3] == 1.0


def test_distances_of_a_scaled_result_are_in_the_truths_unit() -> None:
    truth = IndexedMesh(sphere(10.0, 150))
    result = IndexedMesh(sphere(5.125, 150))  # times two: 10.25
    score = score_surface(
        result, result.sample(5000, 0)[0], whole(truth), Similarity(2.0, np.eye(3), np.zeros(3)), (0.1,)
    )
    assert score.accuracy.median == pytest.approx(0.25, abs=0.005)
    assert score.completeness.median == pytest.approx(0.25, abs=0.005)


def test_reference_points_are_compared_and_aligned_too() -> None:
    truth, S = IndexedMesh(blob()), known_similarity()
    points = truth.sample(30_000, 2)[0]
    reference = PointReference(points, "points")
    result = IndexedMesh(blob().mapped(S.inverse()))
    samples = result.sample(20_000, 0)[0]
    found = reference.align(result, samples, Similarity.identity(), with_scale=True)
    score = score_surface(result, samples, reference, found.S_target_source, (0.05,))
    assert score.scale == pytest.approx(S.scale, rel=1e-6)
    assert score.completeness.p95 < 1e-6  # points to triangles: exact
    spacing = np.sqrt(truth.area / len(points))
    assert 0.2 * spacing < score.accuracy.median < spacing  # triangles to points: their spacing


def test_statistics_are_what_they_say() -> None:
    stats = DistanceStats.of(np.array([0.0, 1.0, 2.0, 7.0]))
    assert (stats.mean, stats.median) == (2.5, 1.5)
    assert stats.rmse == pytest.approx(np.sqrt(54 / 4))
    assert stats.p95 == pytest.approx(np.percentile([0, 1, 2, 7], 95))


def test_signed_distance_is_negative_inside() -> None:
    reference = whole(IndexedMesh(sphere(10.0, 100)))
    np.testing.assert_allclose(
        reference.signed_distance(np.array([[0, 0, 11.0], [0, 0, 9.0], [9.5, 0, 0]])), [1, -1, -0.5], atol=0.01
    )


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        (110.0, (0.1, 0.2, 0.5, 1.0)),
        (0.11, (1e-4, 2e-4, 5e-4, 1e-3)),
        (60.0, (0.05, 0.1, 0.25, 0.5)),
        (1.0, (1e-3, 2e-3, 5e-3, 1e-2)),
    ],
)
def test_default_distances_are_round_and_follow_the_unit(size: float, expected: tuple[float, ...]) -> None:
    assert default_f_distances(size) == expected
