"""What an export hands back and writes, for a ball whose field and poses are known by formula."""

import io
import json
from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.bundle_adjustment.covariance import JointCovariance
from sl_nerfstudio.meshing.files import read_mesh
from sl_nerfstudio.runs.export import export_run
from sl_nerfstudio.runs.export_settings import ExportSettings
from sl_nerfstudio.runs.pose_covariance import COVARIANCE, read_covariance, write_covariance
from sl_nerfstudio.scan import FileError, PoseSigma, Scan, read_pose_sigmas, read_unplaced

from .ball_run import ball_scan, run_of


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    return ball_scan(tmp_path_factory.mktemp("export") / "scan")


def test_the_facts_are_those_of_the_files(scan: Scan, tmp_path):
    sigma = np.arange(1, 25, dtype=float).reshape(6, 4) / 100
    settings = ExportSettings(tmp_path / "mesh.ply", tmp_path / "refined", resolution=64)
    run = run_of(scan, sigma)
    found = export_run(run, settings)
    written, trimmed = read_mesh(settings.mesh), found.surface.trimmed
    assert np.array_equal(written.vertices, found.mesh.vertices) and np.array_equal(written.faces, found.mesh.faces)
    assert trimmed is not None and np.array_equal(trimmed.mesh.vertices, found.mesh.vertices)
    assert trimmed.total > len(found.mesh.vertices) and trimmed.residual_px < 0.2 and found.pose_sigma is sigma
    assert read_pose_sigmas(tmp_path / "refined/transforms.json", scan) == [PoseSigma(*row) for row in sigma.tolist()]
    record = json.loads((tmp_path / "refined/training.json").read_text())
    assert " ".join(record["commands"]["export"]).endswith(f"{tmp_path / 'refined'} --resolution 128 --overwrite")
    assert record["commands"]["train"][:3] == ["ns-train", "sl-neus", "--data"]
    files = sorted(p.name for p in tmp_path.rglob("*") if p.is_file())
    assert files == ["mesh.ply", "pose_covariance.npz", "training.json", "transforms.json"]


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


def test_the_covariance_is_read_as_written_and_a_run_without_it_removes_it(scan: Scan, tmp_path):
    factor = np.random.default_rng(0).normal(size=(78, 50))
    write_covariance(tmp_path, scan, JointCovariance(factor))
    found = read_covariance(tmp_path, scan)
    assert found is not None and np.array_equal(found.factor, factor) and found.frames == 6
    for _ in range(2):
        write_covariance(tmp_path, scan, None)
        assert read_covariance(tmp_path, scan) is None and list(tmp_path.iterdir()) == []


def test_covariances_of_other_scans_and_damaged_ones_are_refused(scan: Scan, tmp_path):
    def content(size: int) -> bytes:
        write_covariance(tmp_path, scan, JointCovariance(np.eye(size)))
        return (tmp_path / COVARIANCE).read_bytes()

    buffer = io.BytesIO()
    np.savez(buffer, something=np.eye(3))
    for of, written, message in (
        (replace(scan, units="cm"), content(78), r"is that of other frames or another unit\n    cause:"),
        (replace(scan, frames=scan.frames[:5]), content(78), "is that of other frames or another unit"),
        (scan, content(78)[:200], "cannot be read"),
        (scan, content(66), r"factor: is float64 \(66, 66\)"),
        (scan, buffer.getvalue(), "cannot be read"),
    ):
        (tmp_path / COVARIANCE).write_bytes(written)
        with pytest.raises(FileError, match=message):
            read_covariance(tmp_path, of)
