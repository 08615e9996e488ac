"""sl-export with a model whose field and poses are known by formula; the real command is in the last part."""

import json
import re
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import tyro

from sl_nerfstudio.cli.export import ExportConfig, check_outputs, export_trained
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.meshing.files import read_mesh
from sl_nerfstudio.model.run_files import plain
from sl_nerfstudio.runs.run import TrainedRun
from sl_nerfstudio.scan import Scan, read_poses
from tests.runs.ball_run import CENTRE, RADIUS, ball_scan, run_of


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    return ball_scan(tmp_path_factory.mktemp("export") / "scan")


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl", ".glb"])
def test_the_mesh_is_in_world_units_and_axes_and_cut(scan, tmp_path, suffix):
    config = ExportConfig(Path("config.yml"), tmp_path / f"mesh{suffix}", resolution=96)
    text = export_trained(run_of(scan), config)
    mesh = read_mesh(config.output, "mm")
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices - CENTRE, axis=1), RADIUS, atol=5e-3)
    assert mesh.vertices[:, 2].min() > CENTRE[2] - 36  # the lower side is seen by nobody
    (evaluation,) = next_commands(text)
    assert evaluation == f"sl-eval --mesh {config.output} --data {scan.root} --report report.html".split()
    text = " ".join(text.split())  # long lines are broken where they need be
    assert f"{len(mesh.vertices):,} vertices" in text and " mm" in text and "vertices that no frame saw" in text


def moved(scan: Scan) -> TrainedRun:
    """A run that refined the poses: a camera stands 0.1 mm elsewhere."""
    T_world_camera = scan.poses.T_world_camera.copy()
    T_world_camera[2, 0, 3] += 0.1
    run = run_of(scan)
    run.model.poses = lambda: DevicePoses(T_world_camera, scan.poses.T_world_projector)  # type: ignore[method-assign]
    return run


def next_commands(text: str) -> list[list[str]]:
    """The commands under `next:`, each as its words."""
    lines = text.partition("next:\n")[2].replace(" \\\n     ", "").splitlines()
    return [shlex.split(line) for line in lines]


def test_the_next_commands_judge_refined_poses_even_if_they_were_not_asked_for(scan, tmp_path):
    config = ExportConfig(
        Path("run 1/config.yml"), tmp_path / "mesh.ply", resolution=48, fill_holes=2.5, trajectory=("tum", "kitti")
    )
    export, evaluation = next_commands(export_trained(moved(scan), config))
    again = tyro.cli(ExportConfig, args=export[1:], config=(tyro.conf.FlagCreatePairsOff,))
    assert export[0] == "sl-export" and again == replace(config, poses=tmp_path / "refined", overwrite=True)
    expected = f"sl-eval --mesh {config.output} --data {scan.root} --poses {tmp_path}/refined/transforms.json"
    assert evaluation == [*expected.split(), "--report", "report.html"]
    (tmp_path / "refined").mkdir()  # of somebody else
    export, evaluation = next_commands(export_trained(moved(scan), config))
    assert export[export.index("--poses") + 1] == str(tmp_path / "mesh-refined")
    assert evaluation[evaluation.index("--poses") + 1] == str(tmp_path / "mesh-refined/transforms.json")


def test_poses_that_were_written_or_not_refined_need_one_command(scan, tmp_path):
    config = ExportConfig(Path("c"), tmp_path / "mesh.ply", resolution=48)
    assert [words[0] for words in next_commands(export_trained(run_of(scan), config))] == ["sl-eval"]
    (words,) = next_commands(export_trained(moved(scan), replace(config, poses=tmp_path / "p")))
    assert words[0] == "sl-eval" and words[5:7] == ["--poses", str(tmp_path / "p/transforms.json")]


@pytest.mark.parametrize("flag", ["watertight", "keep_unobserved"])
def test_a_mesh_with_invented_surface_is_not_sent_to_sl_eval(scan, tmp_path, flag):
    config = ExportConfig(Path("c"), tmp_path / "mesh.ply", resolution=48, **{flag: True})
    text = export_trained(moved(scan), config)
    assert not next_commands(text) and f"export it without --{flag.replace('_', '-')}" in " ".join(text.split())


def test_every_line_fits_a_terminal_unless_it_is_one_word(scan, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = ExportConfig(
        Path("c"), Path("mesh.glb"), resolution=48, target_faces=500, fill_holes=90.0, points=Path("p.las"),
        poses=Path("refined"), cameras=("colmap", "blender"), trajectory=("tum", "kitti"),
    )  # fmt: skip
    lines = export_trained(run_of(replace(scan, units="arbitrary")), config).splitlines()
    assert max(map(len, lines[: lines.index("next:")])) <= 80


def test_keep_unobserved_keeps_the_whole_ball(scan, tmp_path):
    config = ExportConfig(Path("config.yml"), tmp_path / "mesh.ply", resolution=64, keep_unobserved=True)
    assert "nothing was removed" in export_trained(run_of(scan), config)
    assert read_mesh(config.output).vertices[:, 2].min() == pytest.approx(CENTRE[2] - RADIUS, abs=0.1)


def test_poses_come_in_the_format_of_the_scan_with_their_uncertainty(scan, tmp_path):
    sigma = np.arange(1, 25, dtype=float).reshape(6, 4) / 100
    config = ExportConfig(Path("c"), tmp_path / "mesh.ply", poses=tmp_path / "refined", resolution=48)
    text = export_trained(run_of(scan, sigma), config)
    found = read_poses(tmp_path / "refined/transforms.json", scan)
    np.testing.assert_allclose(found.stacked(), scan.poses.stacked(), atol=1e-12)
    document = json.loads((tmp_path / "refined/transforms.json").read_text())
    assert list(document["frames"][1]["sl_pose_sigma"].items()) == [
        ("camera_translation", 0.05),
        ("camera_rotation_deg", 0.06),
        ("relative_translation", 0.07),
        ("relative_rotation_deg", 0.08),
    ]
    assert "poses of 6 frames, camera known to 0.13 mm / 0.14 deg (1 sigma)" in text
    assert f"--poses {tmp_path}/refined/transforms.json" in text


def test_training_record_is_json_with_settings_versions_and_curves(scan, tmp_path):
    export_trained(run_of(scan), ExportConfig(Path("c"), tmp_path / "m.ply", poses=tmp_path / "r", resolution=48))
    record = json.loads((tmp_path / "r/training.json").read_text())
    assert record["settings"]["method_name"] == "sl-neus" and record["settings"]["model"] == {"lr": 1e-3, "where": "a"}
    assert record["versions"]["torch"] == torch.__version__ and "python" in record["versions"]
    assert record["curves"] == {"step": [0.0, 5.0], "loss": [1.0, None]}
    assert record["intrinsics"]["change"] == {
        device: {"focal": 0, "x": 0, "y": 0} for device in ("camera", "projector")
    }
    found = record["intrinsics"]["self_calibration"]
    assert found["contradicts"] and found["chi_square"] == pytest.approx(600)
    assert found["change"]["projector"] == pytest.approx({"focal": 0.01, "x": 0.01, "y": 0.01})
    assert found["sigma"]["camera"] == pytest.approx({"focal": 1e-3, "x": 1e-3, "y": 1e-3})
    assert "sl_pose_sigma" not in (tmp_path / "r/transforms.json").read_text()  # not estimated, so not stated


def test_plain_values_lose_nothing_that_json_has():
    assert plain({"a": (1, 2.5, True, None, "x"), 3: float("inf"), "t": int}) == {
        "a": [1, 2.5, True, None, "x"], "3": None, "t": "int",
    }  # fmt: skip


def test_the_scans_own_file_is_never_replaced(scan, tmp_path):
    config = ExportConfig(Path("c"), tmp_path / "m.ply", poses=scan.root, overwrite=True)
    before = (scan.root / "transforms.json").read_bytes()
    with pytest.raises(UserError, match=r"is the scan's own file"):
        export_trained(run_of(scan), config)
    assert (scan.root / "transforms.json").read_bytes() == before and not config.output.exists()


def test_poor_agreement_is_said(scan, tmp_path):
    shifted = replace(scan, projector=replace(scan.projector, cx=scan.projector.cx + 5.0))
    text = export_trained(run_of(shifted), ExportConfig(Path("c"), tmp_path / "m.ply", resolution=48))
    stated = re.search(r"coordinates differ by ([\d.]+) px \(median\)", text)
    assert stated is not None and float(stated[1]) == pytest.approx(5, abs=0.2) and "warning" in text


def test_outputs_are_checked_before_anything_slow(tmp_path):
    def check(output: Path, **flags) -> None:
        check_outputs(ExportConfig(Path("c"), output, **flags))

    (tmp_path / "old.ply").write_text("old")
    (tmp_path / "refined").mkdir()
    (tmp_path / "refined/training.json").write_text("{}")
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(UserError, match=r"unknown kind of mesh file '.stp'(.|\n)*\.ply, \.obj, \.stl, \.glb"):
        check(tmp_path / "mesh.stp")
    with pytest.raises(UserError, match=r"old.ply: already exists(.|\n)*--overwrite"):
        check(tmp_path / "old.ply")
    check(tmp_path / "old.ply", overwrite=True)
    with pytest.raises(UserError, match=r"training.json: already exists(.|\n)*--overwrite"):
        check(tmp_path / "new.ply", poses=tmp_path / "refined")
    with pytest.raises(UserError, match=r"folder.ply: is a folder"):
        check(tmp_path / "folder.ply", overwrite=True)
    with pytest.raises(UserError, match=r"old.ply is a file, not a folder"):
        check(tmp_path / "old.ply/deeper/mesh.ply")
    with pytest.raises(UserError, match=r"--resolution 1: at least 2 cells"):
        check(tmp_path / "new.ply", resolution=1)
    check(tmp_path / "new/deep/er.ply", poses=tmp_path / "elsewhere/transforms.json")


def test_help_is_quick_because_nothing_heavy_is_imported():
    heavy = ("torch", "nerfstudio", "open3d", "trimesh")
    code = f"import sys, sl_nerfstudio.cli.export; print([m for m in {heavy} if m in sys.modules])"
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"
    )
