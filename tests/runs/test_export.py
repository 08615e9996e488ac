"""What an export hands back and writes, for a ball whose field and poses are known by formula."""

import json
from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.bundle_adjustment.covariance import JointCovariance
from sl_nerfstudio.meshing.files import read_mesh
from sl_nerfstudio.runs.export import COVARIANCE, export_run, read_covariance, training_record, write_covariance
from sl_nerfstudio.runs.export_settings import ExportSettings
from sl_nerfstudio.scan import FileError, PoseSigma, Scan, read_pose_sigmas, read_poses, read_unplaced

from .ball_run import CENTRE, RADIUS, ball_scan, run_of


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    return ball_scan(tmp_path_factory.mktemp("export") / "scan")


def test_the_facts_are_those_of_the_files(scan: Scan, tmp_path):
    sigma = np.arange(1, 25, dtype=float).reshape(6, 4) / 100
    settings = ExportSettings(tmp_path / "mesh.ply", tmp_path / "refined", resolution=64)
    run = run_of(scan, sigma)
    found = export_run(run, settings)
    written = read_mesh(settings.mesh)
    assert np.array_equal(written.vertices, found.mesh.vertices) and np.array_equal(written.faces, found.mesh.faces)
    trimmed = found.surface.trimmed
    assert trimmed is not None and np.array_equal(trimmed.mesh.vertices, found.mesh.vertices)
    assert trimmed.total > len(found.mesh.vertices) and trimmed.residual_px < 0.2
    assert found.pose_sigma is sigma and min(found.surface.extraction_seconds, found.writing_seconds) >= 0
    path = tmp_path / "refined/transforms.json"
    np.testing.assert_allclose(read_poses(path, scan).stacked(), scan.poses.stacked(), atol=1e-12)
    assert read_pose_sigmas(path, scan) == [PoseSigma(*row) for row in sigma.tolist()]
    record = json.loads((tmp_path / "refined/training.json").read_text())
    assert record == json.loads(json.dumps(training_record(run, settings)))
    assert " ".join(record["commands"]["export"]).endswith(f"{tmp_path / 'refined'} --resolution 128 --overwrite")
    assert record["commands"]["train"][:3] == ["ns-train", "sl-neus", "--data"]
    files = sorted(p.name for p in tmp_path.rglob("*") if p.is_file())
    assert files == ["mesh.ply", "pose_covariance.npz", "training.json", "transforms.json"]


def test_without_trimming_the_ball_is_closed_and_no_poses_are_written_unless_wanted(scan: Scan, tmp_path):
    found = export_run(run_of(scan), ExportSettings(tmp_path / "mesh.ply", resolution=64, keep_unobserved=True))
    assert found.surface.trimmed is None and found.pose_sigma is None
    np.testing.assert_allclose(np.linalg.norm(found.mesh.vertices - CENTRE, axis=1), RADIUS, atol=0.02)
    assert found.mesh.is_closed()
    np.testing.assert_allclose(np.ptp(found.mesh.vertices, axis=0), 2 * RADIUS, rtol=2e-3)
    assert [p.name for p in tmp_path.iterdir()] == ["mesh.ply"]


def test_poses_without_an_estimated_uncertainty_state_none(scan: Scan, tmp_path):
    export_run(run_of(scan), ExportSettings(tmp_path / "mesh.ply", tmp_path, resolution=32))
    assert read_pose_sigmas(tmp_path / "transforms.json", scan) == [None] * 6


@pytest.mark.slow
def test_the_area_of_the_trimmed_surface_does_not_depend_on_the_resolution(scan: Scan, tmp_path):
    areas = [
        export_run(run_of(scan), ExportSettings(tmp_path / f"{n}.ply", resolution=n)).mesh.face_areas().sum()
        for n in (64, 96)
    ]
    assert areas[0] == pytest.approx(areas[1], rel=0.03)


def test_a_frame_that_cannot_be_placed_is_marked_and_states_no_uncertainty(scan: Scan, tmp_path):
    run = run_of(scan, np.ones((6, 4)))
    run.model.last_unplaced = True
    export_run(run, ExportSettings(tmp_path / "mesh.ply", tmp_path, resolution=32))
    assert read_unplaced(tmp_path / "transforms.json", scan) == [scan.frames[-1].name]
    assert [s is None for s in read_pose_sigmas(tmp_path / "transforms.json", scan)] == [False] * 5 + [True]


def test_what_was_written_is_read_and_a_run_without_it_removes_it(scan: Scan, tmp_path):
    factor = np.random.default_rng(0).normal(size=(78, 50))
    write_covariance(tmp_path, scan, JointCovariance(factor))
    found = read_covariance(tmp_path, scan)
    assert found is not None and np.array_equal(found.factor, factor) and found.frames == 6
    write_covariance(tmp_path, scan, None)
    assert read_covariance(tmp_path, scan) is None and list(tmp_path.iterdir()) == []
    write_covariance(tmp_path, scan, None)


def test_files_of_other_scans_and_damaged_ones_are_refused(scan: Scan, tmp_path):
    joint = JointCovariance(np.eye(78))
    write_covariance(tmp_path, scan, joint)
    for other in (replace(scan, units="cm"), replace(scan, frames=scan.frames[:5])):
        with pytest.raises(FileError, match=r"is that of other frames or another unit\n    cause:"):
            read_covariance(tmp_path, other)
    content = (tmp_path / COVARIANCE).read_bytes()
    (tmp_path / COVARIANCE).write_bytes(content[: len(content) // 2])
    with pytest.raises(FileError, match="cannot be read"):
        read_covariance(tmp_path, scan)
    write_covariance(tmp_path, scan, JointCovariance(np.eye(66)))
    with pytest.raises(FileError, match=r"factor: is float64 \(66, 66\)"):
        read_covariance(tmp_path, scan)
    np.savez(tmp_path / COVARIANCE, something=np.eye(3))
    with pytest.raises(FileError, match="cannot be read"):
        read_covariance(tmp_path, scan)
