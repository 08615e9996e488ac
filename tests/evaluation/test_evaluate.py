import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.evaluation.evaluate import Evaluation, evaluate
from sl_nerfstudio.evaluation.judgement import judge, to_json
from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.evaluation.reference import PointReference, mesh_reference
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.scan import read_scan

from .faceted_scan import FacetedScan
from .shapes import turn

SAMPLES = 5000


def evaluated(root: Path, mesh: Mesh, made: FacetedScan, poses: DevicePoses | None = None) -> Evaluation:
    scan, true = read_scan(root), made.true_poses()
    reference = mesh_reference(made.truth(), scan, true, SAMPLES)
    start = scan.poses
    return evaluate(mesh, scan, poses or start, reference, true, samples=SAMPLES)


def test_a_result_in_another_gauge_is_perfect_once_aligned(clean_scan: Path) -> None:
    """The whole result, mesh and poses, lies far away, turned by 100 degrees and 3 % too large."""
    made = FacetedScan()
    S = Similarity(1.03, turn((0.2, 1.0, -0.4), 100.0), np.array([300.0, -80.0, 40.0]))
    result = evaluated(clean_scan, made.truth().mapped(S), made, made.true_poses().mapped(S))
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


def test_reference_points_in_the_scans_world_are_found_from_a_result_of_another_gauge(clean_scan: Path) -> None:
    """No true poses: the scan's own ones lead to the reference, though the result is 60 times smaller and far away."""
    made, scan = FacetedScan(), read_scan(clean_scan)
    S = Similarity(1 / 60, turn((0.2, 1.0, -0.4), 100.0), np.array([300.0, -80.0, 40.0]))
    points = IndexedMesh(made.truth()).sample(20 * SAMPLES, 3)[0]
    poses = scan.poses.mapped(S)
    result = evaluate(made.truth().mapped(S), scan, poses, PointReference(points, "points"), samples=SAMPLES)
    assert result.surface["similarity"].scale == pytest.approx(60, rel=1e-3)
    assert result.surface["similarity"].accuracy.p95 < 0.5  # distances between 100,000 points on 100 mm
    assert result.pose_errors is None


def as_json(evaluation: Evaluation) -> dict:
    return to_json(evaluation, judge(evaluation).verdict)


def test_json_has_what_the_command_promises(clean_scan: Path) -> None:
    content = as_json(evaluated(clean_scan, FacetedScan().truth(), FacetedScan()))
    assert json.loads(json.dumps(content, allow_nan=False)) == content
    assert content["units"] == content["truth_units"] == "mm"
    for name in ("rigid", "similarity", "none"):
        block = content[name]
        for distances in ("accuracy", "completeness"):
            assert set(block[distances]) == {"mean", "median", "rmse", "p95"}
        assert set(block) >= {"chamfer", "f_score", "scale"}
        assert all(0 <= value <= 1 for value in block["f_score"].values())
        assert [float(d) for d in block["f_score"]] == sorted(float(d) for d in block["f_score"])
    for device in ("camera", "projector"):
        assert set(content[device]) >= {"translation_rmse", "rotation_rmse_deg"}
    assert set(content["fit"]) >= {"coordinate_px_median", "epipolar_px_median", "pattern_cosine", "frames"}
    assert content["verdict"] in ("good", "acceptable", "poor") and isinstance(content["reasons"], list)
    assert set(content["fit"]["frames"][0]) >= {"coordinate_px_p95", "covered_share", "agreeing_share", "largest_hole"}
    assert len(content["cross_frame"]["frames"]) == 3


def test_a_scan_of_unknown_unit_is_judged_in_that_of_the_truth(clean_scan: Path) -> None:
    """A result that is 60 times too small and off by 1 % of its size: by half a millimetre, says the truth."""
    made, scan = FacetedScan(), replace(read_scan(clean_scan), units="arbitrary")
    S = Similarity(1 / 60, np.eye(3), np.zeros(3))
    vertices = made.truth().vertices
    poses = scan.poses.mapped(S)
    noisy = Mesh(vertices + np.random.default_rng(0).normal(0, 0.5, vertices.shape), made.truth().faces)
    reference = mesh_reference(made.truth(), scan, made.true_poses(), SAMPLES)
    evaluation = evaluate(noisy.mapped(S), scan, poses, reference, made.true_poses(), samples=SAMPLES)
    assert list(evaluation.comparable) == [
        "similarity"
    ]  # a person is not shown distances of 60 times too small a thing
    content = as_json(evaluation)
    assert (content["units"], content["truth_units"]) == ("arbitrary", "units of the truth")
    assert 0.1 < content["similarity"]["accuracy"]["rmse"] < 1.0
    assert content["camera"]["translation_rmse"] < 1e-6


def test_without_truth_only_the_fit_is_there(clean_scan: Path) -> None:
    scan = read_scan(clean_scan)
    content = as_json(evaluate(FacetedScan().truth(), scan, scan.poses))
    assert set(content) == {"format", "verdict", "reasons", "units", "fit", "coverage", "cross_frame"}
    assert content["fit"]["coordinate_px_median"] < 1e-3


def test_figures_repeat_with_the_seed(clean_scan: Path) -> None:
    first, second = (as_json(evaluated(clean_scan, FacetedScan().truth(), FacetedScan())) for _ in range(2))
    assert first == second


def test_initial_pose_errors_are_those_that_were_put_in(tmp_path: Path) -> None:
    made = FacetedScan(frames=6, wrong_poses_deg=2.0)
    root = made.write(tmp_path / "scan")
    result = evaluated(root, made.truth(), made)
    assert result.pose_errors is not None
    assert result.initial_pose_errors is None  # the starting poses are the evaluated ones
    assert result.starting_poses
    assert 1.0 < result.pose_errors.camera.rotation_rmse_deg <= 2.2
    assert result.pose_errors.relative.rotation_rmse_deg < 1e-6  # frames moved as a whole


def test_figures_do_not_depend_on_the_unit(tmp_path: Path) -> None:
    in_mm = FacetedScan(wrong_poses_deg=1.0)
    in_m = FacetedScan(wrong_poses_deg=1.0, units="m", scale=0.04)
    swollen = Mesh(in_mm.mesh.vertices * 1.02, in_mm.mesh.faces)
    mm, m = (
        as_json(evaluated(made.write(tmp_path / made.units), FacetedScan(scale=made.scale, mesh=swollen).truth(), made))
        for made in (in_mm, in_m)
    )
    assert m["rigid"]["accuracy"]["rmse"] * 1000 == pytest.approx(mm["rigid"]["accuracy"]["rmse"], rel=1e-4)
    assert m["camera"]["translation_rmse"] * 1000 == pytest.approx(mm["camera"]["translation_rmse"], rel=1e-6)
    assert list(m["rigid"]["f_score"].values()) == pytest.approx(list(mm["rigid"]["f_score"].values()), abs=1e-3)
    assert m["fit"]["coordinate_px_median"] == pytest.approx(mm["fit"]["coordinate_px_median"], rel=1e-3)


def test_mesh_in_another_unit_is_refused_with_the_sizes(clean_scan: Path) -> None:
    scan = read_scan(clean_scan)
    far = Mesh(FacetedScan().truth().vertices / 1000 + 500.0, FacetedScan().truth().faces)
    with pytest.raises(
        UserError, match=r"no camera ray .* hits the mesh\n.*mesh measures 0\.1\d*, and the cameras are .* away .*mm"
    ) as error:
        evaluate(far, scan, scan.poses)
    assert "remedy: give the mesh that was exported from this scan" in str(error.value)


def test_reference_inside_out_is_refused(clean_scan: Path) -> None:
    scan, truth = read_scan(clean_scan), FacetedScan().truth()
    turned = Mesh(truth.vertices, truth.faces[:, ::-1].copy())
    with pytest.raises(UserError, match="inside out"):
        mesh_reference(turned, scan, scan.poses, SAMPLES)
