"""The whole evaluation of a result, its scores, and distances with their uncertainty."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sl_nerfstudio.bundle_adjustment.covariance import JointCovariance
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.evaluation.evaluate import (
    Evaluation,
    PointPair,
    default_f_distances,
    evaluate,
    measure_lengths,
    parse_pair,
    read_pairs,
    score_surface,
    typical_sigma,
)
from sl_nerfstudio.evaluation.judgement import judge, to_json
from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.evaluation.reference import MeshReference, PointReference, mesh_reference
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity, exp_se3
from sl_nerfstudio.meshing.mesh import Mesh, VertexQuality
from sl_nerfstudio.meshing.uncertainty import point_changes, views_by_frame
from sl_nerfstudio.scan import Scan, read_scan
from tests import formulas

from .faceted_scan import CAMERA, MADE, PROJECTOR, TRUTH, FacetedScan
from .shapes import blob, known_similarity, sphere, turn

SAMPLES = 5000


def evaluated(scan: Scan, mesh: Mesh, made: FacetedScan = MADE, poses: DevicePoses | None = None) -> Evaluation:
    true = made.true_poses()
    reference = mesh_reference(made.truth(), scan, true, SAMPLES)
    return evaluate(mesh, scan, poses or scan.poses, reference, true, samples=SAMPLES)


def elsewhere(scale: float) -> Similarity:
    """Far away, turned by 100 degrees and of another size."""
    return Similarity(scale, turn((0.2, 1.0, -0.4), 100.0), np.array([300.0, -80.0, 40.0]))


def test_a_result_in_another_gauge_is_perfect_once_aligned(scan: Scan) -> None:
    """The whole result, mesh and poses, lies elsewhere and is 3 % too large."""
    S = elsewhere(1.03)
    result = evaluated(scan, TRUTH.mapped(S), poses=MADE.true_poses().mapped(S))
    similarity, rigid = result.surface["similarity"], result.surface["rigid"]
    assert similarity.scale == pytest.approx(1 / 1.03, rel=1e-6)
    assert similarity.accuracy.p95 < 1e-3 and similarity.completeness.p95 < 1e-3
    assert 0.3 < rigid.accuracy.median < 1.5  # 3 % of a radius of about 30
    assert rigid.scale == 1.0
    assert result.surface["none"].accuracy.median > 50
    assert result.pose_errors is not None and result.initial_pose_errors is not None
    assert result.pose_errors.camera.translation_rmse < 1e-9
    assert result.pose_errors.scale_error == pytest.approx(0.03, rel=1e-9)
    assert result.initial_pose_errors.scale_error == pytest.approx(0.0, abs=1e-12)
    assert result.agreement.coordinate_px_median < 1e-2


def test_reference_points_in_the_scans_world_are_found_from_a_result_of_another_gauge(scan: Scan) -> None:
    """No true poses: the scan's own ones lead to the reference, though the result is 60 times smaller and far away."""
    S, points = elsewhere(1 / 60), PointReference(IndexedMesh(TRUTH).sample(SAMPLES, 3)[0], "points")
    result = evaluate(TRUTH.mapped(S), scan, scan.poses.mapped(S), points, samples=SAMPLES)
    assert result.surface["similarity"].scale == pytest.approx(60, rel=1e-3)
    assert result.surface["similarity"].accuracy.p95 < 2.5  # distances between 5,000 points on 100 mm
    assert result.pose_errors is None


def as_json(evaluation: Evaluation) -> dict:
    return to_json(evaluation, judge(evaluation).verdict)


def test_json_has_what_the_command_promises_and_repeats_with_the_seed(scan: Scan) -> None:
    content, again = (as_json(evaluated(scan, TRUTH)) for _ in range(2))
    assert content == again
    assert json.loads(json.dumps(content, allow_nan=False)) == content
    assert content["units"] == content["truth_units"] == "mm"
    for name in ("rigid", "similarity", "none"):
        block = content[name]
        assert set(block) >= {"accuracy", "completeness", "chamfer", "f_score", "scale"}
        assert all(set(block[key]) == {"mean", "median", "rmse", "p95"} for key in ("accuracy", "completeness"))
        assert [float(d) for d in block["f_score"]] == sorted(float(d) for d in block["f_score"])
    for device in ("camera", "projector"):
        assert set(content[device]) >= {"translation_rmse", "rotation_rmse_deg"}
    assert set(content["fit"]) >= {"coordinate_px_median", "epipolar_px_median", "pattern_cosine", "frames"}
    assert set(content["fit"]["frames"][0]) >= {"coordinate_px_p95", "covered_share", "agreeing_share", "largest_hole"}
    assert len(content["cross_frame"]["frames"]) == 3
    alone = as_json(evaluate(TRUTH, scan, scan.poses))  # without truth
    assert set(alone) == {"format", "verdict", "reasons", "units", "fit", "coverage", "cross_frame"}
    assert alone["fit"]["coordinate_px_median"] < 1e-3


def test_a_scan_of_unknown_unit_is_judged_in_that_of_the_truth(scan: Scan) -> None:
    """A result that is 60 times too small and off by 1 % of its size: by half a millimetre, says the truth."""
    S, noise = Similarity.scaling(1 / 60), np.random.default_rng(0).normal(0, 0.5, TRUTH.vertices.shape)
    noisy = Mesh(TRUTH.vertices + noise, TRUTH.faces).mapped(S)
    evaluation = evaluated(replace(scan, units="arbitrary"), noisy, poses=scan.poses.mapped(S))
    assert list(evaluation.comparable) == ["similarity"]  # nobody is shown distances of 60 times too small a thing
    content = as_json(evaluation)
    assert (content["units"], content["truth_units"]) == ("arbitrary", "units of the truth")
    assert 0.1 < content["similarity"]["accuracy"]["rmse"] < 1.0
    assert content["camera"]["translation_rmse"] < 1e-6


def test_initial_pose_errors_are_those_that_were_put_in(tmp_path: Path) -> None:
    made = FacetedScan(frames=6, wrong_poses_deg=2.0)
    result = evaluated(read_scan(made.write(tmp_path / "scan")), made.truth(), made)
    assert result.pose_errors is not None
    assert result.initial_pose_errors is None  # the starting poses are the evaluated ones
    assert result.starting_poses
    assert 1.0 < result.pose_errors.camera.rotation_rmse_deg <= 2.2
    assert result.pose_errors.relative.rotation_rmse_deg < 1e-6  # frames moved as a whole


def test_figures_do_not_depend_on_the_unit(tmp_path: Path) -> None:
    in_mm = FacetedScan(wrong_poses_deg=1.0)
    in_m = FacetedScan(wrong_poses_deg=1.0, units="m", scale=0.04)
    swollen = Similarity.scaling(1.02)
    mm, m = (
        as_json(evaluated(read_scan(made.write(tmp_path / made.units)), made.truth().mapped(swollen), made))
        for made in (in_mm, in_m)
    )
    assert m["rigid"]["accuracy"]["rmse"] * 1000 == pytest.approx(mm["rigid"]["accuracy"]["rmse"], rel=1e-4)
    assert m["camera"]["translation_rmse"] * 1000 == pytest.approx(mm["camera"]["translation_rmse"], rel=1e-6)
    assert list(m["rigid"]["f_score"].values()) == pytest.approx(list(mm["rigid"]["f_score"].values()), abs=1e-3)
    assert m["fit"]["coordinate_px_median"] == pytest.approx(mm["fit"]["coordinate_px_median"], rel=1e-3)


def test_a_mesh_in_another_unit_and_a_reference_inside_out_are_refused(scan: Scan) -> None:
    far = Mesh(TRUTH.vertices / 1000 + 500.0, TRUTH.faces)
    said = r"no camera ray .* hits the mesh\n.*mesh measures 0\.1\d*, and the cameras are .* away .*mm"
    with pytest.raises(UserError, match=rf"{said}[\s\S]*remedy: give the mesh that was exported from this scan"):
        evaluate(far, scan, scan.poses)
    with pytest.raises(UserError, match="inside out"):
        mesh_reference(Mesh(TRUTH.vertices, TRUTH.faces[:, ::-1].copy()), scan, scan.poses, SAMPLES)


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
    samples = result.sample(20_000, 0)[0]
    score = score_surface(result, samples, whole(IndexedMesh(truth)), Similarity.identity(), (0.01,))
    assert score.accuracy.p95 < 1e-6
    assert score.completeness.p95 > 5
    assert score.f_score[0.01] == pytest.approx(2 / 3, abs=0.01)  # precision 1, recall 1/2


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


def test_default_distances_are_round_and_follow_the_unit() -> None:
    for size, expected in ((110.0, (0.1, 0.2, 0.5, 1.0)), (0.11, (1e-4, 2e-4, 5e-4, 1e-3)),
                           (60.0, (0.05, 0.1, 0.25, 0.5)), (1.0, (1e-3, 2e-3, 5e-3, 1e-2))):  # fmt: skip
        assert default_f_distances(size) == expected


FRAMES = 3


@pytest.fixture(scope="module")
def rows(scan: Scan) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices that frames confirm, the derivatives of those points, and the frames that confirm each."""
    every = list(views_by_frame(TRUTH, scan, scan.poses, None, "test"))
    chosen = np.unique(np.concatenate([view.vertex for view in every]))
    seen = np.stack([np.isin(chosen, view.vertex) for view in every], 1)
    return chosen, point_changes(TRUTH, scan, scan.poses, every, chosen, np.eye(12 * FRAMES + 6)), seen


def quality() -> VertexQuality:
    count = len(TRUTH.vertices)
    return VertexQuality(*(np.full(count, value) for value in (0.05, 0.03, 2, 0.0, 0.0)))


def test_a_point_is_where_the_rays_of_all_its_pixels_meet_best(scan, rows):
    """With disturbed poses, least squares on the plain pinhole formulas, from the pixels under the true ones."""
    chosen, found, seen = rows
    row = int(seen.sum(1).argmax())
    p, frames = TRUTH.vertices[chosen[row]], np.flatnonzero(seen[row])
    step = np.random.default_rng(0).normal(size=(2, FRAMES, 6)) * ([1e-3] * 3 + [1e-5] * 3)

    def pixels(at: np.ndarray, sign: float) -> np.ndarray:
        out = []
        delta, rho = (exp_se3(sign * torch.from_numpy(part)).numpy() for part in step)
        for k in frames:
            camera = delta[k] @ scan.poses.T_world_camera[k]
            light = camera @ rho[k] @ scan.poses.T_camera_projector[k]
            for device, T in ((CAMERA, camera), (PROJECTOR, light)):
                out.append(formulas.pixels(device, T, at))
        return np.concatenate(out)

    decoded, ends = pixels(p, 0.0), []
    for sign in (1.0, -1.0):
        at = p.copy()
        for _ in range(4):
            J = np.stack([(pixels(at + h, sign) - pixels(at - h, sign)) / 2e-4 for h in 1e-4 * np.eye(3)], 1)
            at = at - np.linalg.lstsq(J, pixels(at, sign) - decoded, rcond=None)[0]
        ends.append(at)
    expected = (ends[0] - ends[1]) / 2
    np.testing.assert_allclose(found[row, :, : 12 * FRAMES] @ step.ravel(), expected, rtol=1e-3, atol=1e-6)


def test_a_length_has_the_uncertainty_of_its_ends(scan, rows):
    chosen, found, _ = rows
    ends = TRUTH.vertices[chosen[[0, -1]]]
    pair = PointPair("edge", *map(tuple, ends.tolist()))
    joint = JointCovariance(np.random.default_rng(1).normal(size=(12 * FRAMES + 6,) * 2) * 1e-3)
    (length,) = measure_lengths([pair], TRUTH, quality(), scan, scan.poses, joint)
    u = ends[1] - ends[0]
    assert length.length == pytest.approx(np.linalg.norm(u), rel=1e-6)
    u = u / np.linalg.norm(u)
    row = u @ (found[-1] - found[0])
    assert length.sigma_shared == pytest.approx(np.sqrt(row @ joint.matrix @ row), rel=1e-9)
    independent = 0.03 * np.hypot(*(TRUTH.vertex_normals()[chosen[[0, -1]]] @ u))
    assert length.sigma_independent == pytest.approx(independent, rel=1e-9)
    assert length.sigma == pytest.approx(np.hypot(length.sigma_shared, independent)) and length.views == (2, 2)
    rigid = np.r_[np.tile([1.0, 2, 3, 0.1, 0.2, 0.3], FRAMES), np.zeros(6 * FRAMES + 6)]
    (still,) = measure_lengths([pair], TRUTH, quality(), scan, scan.poses, JointCovariance(rigid[:, None]))
    assert still.sigma_shared == pytest.approx(0, abs=1e-5)
    for known in ((None, joint), (quality(), None)):
        (unknown,) = measure_lengths([pair], TRUTH, known[0], scan, scan.poses, known[1])
        assert unknown.sigma is None and unknown.length == length.length


def test_what_is_typical_of_lengths_is_their_growth(scan):
    """If all poses grow by a common, unknown factor, every length is as uncertain as the factor."""
    known = quality()
    growth = np.zeros((2, FRAMES, 6))
    growth[0, :, :3] = scan.poses.T_world_camera[:, :3, 3]
    growth[1, :, :3] = scan.poses.T_camera_projector[:, :3, 3]
    step = 0.01 * np.r_[growth.ravel(), np.zeros(6)]
    exact = replace(known, sigma_independent=np.zeros(len(TRUTH.vertices)))
    joint = JointCovariance(step[:, None])
    assert typical_sigma(TRUTH, exact, scan, scan.poses, joint) == pytest.approx(0.01, rel=1e-6)
    unseen = replace(known, views=np.zeros_like(known.views))
    for quality_, joint_ in ((None, joint), (known, None), (unseen, joint)):
        assert typical_sigma(TRUTH, quality_, scan, scan.poses, joint_) is None


def test_pairs_are_read_as_they_are_written(tmp_path):
    pair = parse_pair("1,2,3 -4,.5,6e1", "--distance")
    assert pair == PointPair("1,2,3 to -4,.5,6e1", (1.0, 2.0, 3.0), (-4.0, 0.5, 60.0))
    file = tmp_path / "features.txt"
    file.write_text("# what matters\n\nhandle: -1,0,0 1,0,0\n  a: b: 0,0,0  0,0,2.5 \n")
    assert [pair.name for pair in read_pairs(file)] == ["handle", "a: b"]
    for bad in ("1,2,3", "1,2,3 4,5", "1 2 3 4 5 6", ": 1,2,3 4,5,6", "1,2,3 4,5,nan"):
        with pytest.raises(UserError, match=r"is not two points\n    remedy: give x,y,z of both"):
            parse_pair(bad, "--distance")
    for text, message in (
        ("ok: 0,0,0 1,1,1\nbad: 0,0,0\n", r"features.txt, line 2: 'bad: 0,0,0' is not two points"),
        ("# nothing\n", "holds no distances"),
        (None, "cannot be read"),
    ):
        file.unlink() if text is None else file.write_text(text)
        with pytest.raises(UserError, match=message):
            read_pairs(file)


def test_points_beside_the_mesh_are_refused(scan):
    a = tuple(TRUTH.vertices[0].tolist())
    with pytest.raises(UserError, match=r"500,0,0 is .* away from the surface \(unit: mm\)\n    cause:"):
        measure_lengths([PointPair("far", a, (500.0, 0.0, 0.0))], TRUTH, None, scan, scan.poses, None)
    with pytest.raises(UserError, match="both points are the same"):
        measure_lengths([PointPair("none", a, a)], TRUTH, None, scan, scan.poses, None)
