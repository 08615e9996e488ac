"""sl-export with a ball whose field and poses are known by formula: meshes, poses, files of other programs."""

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pycolmap
import pytest
import torch
import trimesh
import tyro

from sl_nerfstudio.cli.export import ExportConfig, check_outputs, export_trained, main, summary
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.evaluation.evaluate import read_inputs
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.meshing.files import read_mesh
from sl_nerfstudio.runs.run import TrainedRun
from sl_nerfstudio.scan import Scan
from sl_nerfstudio.scan.images import encode_png
from tests.runs.ball_run import CENTRE, RADIUS, ball_scan, run_of

from .snapshots import expect, expect_refusals, masked

COLOUR = (200, 100, 50)


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    return ball_scan(tmp_path_factory.mktemp("export") / "scan")


@pytest.fixture(scope="module")
def coloured(scan) -> Scan:
    """The same scan, of which two frames were also taken without the pattern."""
    camera, path = scan.frames[0].camera, scan.root / "one_colour.png"
    path.write_bytes(encode_png(np.full((camera.h, camera.w, 3), COLOUR, dtype=np.uint8)))
    pictures = [replace(frame, color_path=path) for frame in scan.frames[:2]]
    return replace(scan, frames=(*pictures, *scan.frames[2:]))


def exported(scan: Scan | TrainedRun, output: Path, resolution: int = 48, **flags) -> str:
    """What is said, in one line: where lines break depends on the length of paths."""
    return " ".join(said(scan, output, resolution, **flags).split())


def said(scan: Scan | TrainedRun, output: Path, resolution: int = 48, **flags) -> str:
    config = ExportConfig(Path("c"), output, resolution=resolution, **flags)
    check_outputs(config)
    return summarised(scan, config)


def summarised(scan: Scan | TrainedRun, config: ExportConfig) -> str:
    trained = run_of(scan) if isinstance(scan, Scan) else scan
    return summary(config, trained.model.scan, export_trained(trained, config))


def vertex_data(path: Path) -> np.ndarray:
    return trimesh.load(path, process=False).metadata["_ply_raw"]["vertex"]["data"]


def off_ball(vertices: np.ndarray) -> np.ndarray:
    return np.abs(np.linalg.norm(vertices - CENTRE, axis=1) - RADIUS)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl", ".glb"])
def test_the_mesh_is_in_world_units_and_axes_and_cut_and_sl_eval_takes_it_back(scan, tmp_path, suffix):
    text = exported(scan, tmp_path / f"mesh{suffix}", 96)
    mesh = read_inputs(tmp_path / f"mesh{suffix}", scan.root, None, None, 100, 0).mesh
    assert off_ball(mesh.vertices).max() < 5e-3
    assert mesh.vertices[:, 2].min() > CENTRE[2] - 36  # the lower side is seen by nobody
    assert f"{len(mesh.vertices):,} vertices" in text and "vertices that no frame saw" in text


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
    export, evaluation = next_commands(summarised(moved(scan), config))
    again = tyro.cli(ExportConfig, args=export[1:], config=(tyro.conf.FlagCreatePairsOff,))
    assert export[0] == "sl-export" and again == replace(config, poses=tmp_path / "refined", overwrite=True)
    expected = f"sl-eval --mesh {config.output} --data {scan.root} --poses {tmp_path}/refined/transforms.json"
    assert evaluation == [*expected.split(), "--report", "report.html"]
    (tmp_path / "refined").mkdir()  # of somebody else
    export, evaluation = next_commands(summarised(moved(scan), config))
    assert export[export.index("--poses") + 1] == str(tmp_path / "mesh-refined")
    assert evaluation[evaluation.index("--poses") + 1] == str(tmp_path / "mesh-refined/transforms.json")
    config = replace(config, output=tmp_path / "b.ply", trajectory=())
    assert [words[0] for words in next_commands(summarised(scan, config))] == ["sl-eval"]
    (words,) = next_commands(summarised(moved(scan), replace(config, poses=tmp_path / "p")))
    assert words[0] == "sl-eval" and words[5:7] == ["--poses", str(tmp_path / "p/transforms.json")]


@pytest.mark.parametrize("flag", ["watertight", "keep_unobserved"])
def test_a_mesh_with_invented_surface_is_marked_and_not_sent_to_sl_eval(scan, tmp_path, monkeypatch, flag):
    monkeypatch.chdir(tmp_path)
    text = said(moved(scan), Path("solid.ply"), **{flag: True})
    assert not next_commands(text)
    expect("sl-export", flag, masked(text))
    solid = trimesh.load_mesh("solid.ply", process=False)
    data = vertex_data(Path("solid.ply"))
    invented = data["invented"] > 0
    assert solid.is_watertight and solid.is_winding_consistent and invented.mean() > 0.1
    share = solid.area_faces[invented[solid.faces].any(1)].sum() / solid.area
    assert f"{share:.0%} of the area is invented" in text and off_ball(solid.vertices)[~invented].max() < 0.02
    if flag == "watertight":  # flat, a cell below what was seen
        lowest, cell = solid.vertices[~invented, 2].min(), 2 / 48 * 60
        assert solid.vertices[:, 2].min() == pytest.approx(lowest - cell, abs=0.6)
    else:
        assert np.array_equal(invented, data["views"] == 0)
        assert solid.vertices[:, 2].min() == pytest.approx(CENTRE[2] - RADIUS, abs=0.1)


def test_a_solid_with_few_triangles_is_closed_and_in_millimetres(scan, tmp_path, monkeypatch):
    exported(scan, tmp_path / "print.stl", watertight=True, target_faces=600)
    solid = trimesh.load_mesh(tmp_path / "print.stl")
    assert solid.is_watertight and len(solid.faces) <= 600
    assert solid.extents[0] == pytest.approx(2 * RADIUS, rel=0.02)
    monkeypatch.setattr("sl_nerfstudio.meshing.mesh.Mesh.is_closed", lambda _: False)
    with pytest.raises(UserError, match=r"--target-faces 8: the surface is no longer closed(.|\n)*keep more triangles"):
        exported(scan, tmp_path / "a.stl", watertight=True, target_faces=8)
    with pytest.raises(UserError, match=r"--watertight: the surface is not closed at --resolution 48(.|\n)*remedy"):
        exported(scan, tmp_path / "a.stl", watertight=True)
    assert not (tmp_path / "a.stl").exists()


def test_holes_are_filled_up_to_a_size_in_mm_and_marked(scan, tmp_path):
    """The ball lacks its lower side: a hole of about 60 mm. In a scan in cm it is as large."""
    text = exported(scan, tmp_path / "open.ply", fill_holes=20.0)
    assert "closed 0 holes of up to 20 mm" in text and "holes that stay open: 1 that are larger" in text
    assert "closed 0 holes" in exported(replace(scan, units="cm"), tmp_path / "cm.ply", fill_holes=90.0)  # 60 cm
    text = exported(scan, tmp_path / "filled.ply", fill_holes=90.0, target_faces=2000)
    data, mesh = vertex_data(tmp_path / "filled.ply"), trimesh.load_mesh(tmp_path / "filled.ply", process=False)
    invented = data["invented"] > 0
    assert "closed 1 holes of up to 90 mm" in text and mesh.is_watertight and 0.1 < invented.mean() < 0.4
    assert (data["z"][invented] < CENTRE[2] - 18).all() and (data["views"][invented] == 0).mean() > 0.9
    assert np.isfinite(data["sigma"][~invented]).mean() > 0.95


def test_poses_and_training_record_come_in_the_format_of_the_scan_with_their_uncertainty(scan, tmp_path):
    sigma = np.arange(1, 25, dtype=float).reshape(6, 4) / 100
    text = exported(run_of(scan, sigma), tmp_path / "mesh.ply", poses=tmp_path / "r")
    document = json.loads((tmp_path / "r/transforms.json").read_text())
    keys = ("camera_translation", "camera_rotation_deg", "relative_translation", "relative_rotation_deg")
    assert document["frames"][1]["sl_pose_sigma"] == dict(zip(keys, (0.05, 0.06, 0.07, 0.08), strict=True))
    assert "poses of 6 frames, camera known to 0.13 mm / 0.14 deg (1 sigma)" in text
    record = json.loads((tmp_path / "r/training.json").read_text())
    assert record["settings"]["method_name"] == "sl-neus" and record["settings"]["model"] == {"lr": 1e-3, "where": "a"}
    assert record["versions"]["torch"] == torch.__version__ and "python" in record["versions"]
    assert record["curves"] == {"step": [0.0, 5.0], "loss": [1.0, None]}
    unchanged = {"focal": 0, "x": 0, "y": 0}
    assert record["intrinsics"]["change"] == {"camera": unchanged, "projector": unchanged}
    calibration = record["intrinsics"]["self_calibration"]
    assert calibration["contradicts"] and calibration["chi_square"] == pytest.approx(600)
    assert calibration["change"]["projector"] == pytest.approx({"focal": 0.01, "x": 0.01, "y": 0.01})
    assert calibration["sigma"]["camera"] == pytest.approx({"focal": 1e-3, "x": 1e-3, "y": 1e-3})


def test_the_scans_own_file_is_never_replaced(scan, tmp_path):
    before = (scan.root / "transforms.json").read_bytes()
    with pytest.raises(UserError, match=r"is the scan's own file"):
        exported(scan, tmp_path / "m.ply", poses=scan.root, overwrite=True)
    assert (scan.root / "transforms.json").read_bytes() == before and not (tmp_path / "m.ply").exists()


def test_poor_agreement_is_said(scan, tmp_path):
    shifted = replace(scan, projector=replace(scan.projector, cx=scan.projector.cx + 5.0))
    text = exported(shifted, tmp_path / "m.ply")
    stated = re.search(r"coordinates differ by ([\d.]+) px \(median\)", text)
    assert stated is not None and float(stated[1]) == pytest.approx(5, abs=0.2) and "warning" in text


def test_every_file_at_once_and_other_programs_read_them(scan, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = said(
        scan, Path("mesh.obj"), poses=Path("refined"), points=Path("cloud.las"), target_faces=900, fill_holes=90.0,
        cameras=("colmap", "blender"), trajectory=("tum", "kitti"), largest_component=True,
    )  # fmt: skip
    expect("sl-export", "run", masked(text.replace(str(scan.root), "SCAN")))
    assert max(map(len, text.partition("next:")[0].splitlines())) <= 80
    colmap = {f"refined/colmap/{name}.txt" for name in ("cameras", "rigs", "frames", "images", "points3D")}
    assert {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()} == colmap | {
        "mesh.obj", "mesh.mtl", "cloud.las", "refined/transforms.json", "refined/training.json",
        "refined/cameras_blender.py", "refined/camera_tum.txt", "refined/projector_tum.txt",
        "refined/camera_kitti.txt", "refined/projector_kitti.txt",
    }  # fmt: skip
    model = pycolmap.Reconstruction()
    model.read_text(str(tmp_path / "refined/colmap"))
    assert len(model.images) == 12 and model.compute_mean_reprojection_error() < 0.2
    assert off_ball(np.array([p.xyz for p in model.points3D.values()])).max() < 0.05  # the scan's unit, mm
    assert off_ball(laspy.read("cloud.las").xyz * 1000).max() < 0.05
    times = np.loadtxt("refined/camera_tum.txt")
    np.testing.assert_allclose(times[:, 1:4] * 1000, scan.poses.T_world_camera[:, :3, 3], atol=1e-6)
    assert len(trimesh.load_mesh("mesh.obj").faces) <= 900
    blender = json.loads(Path("refined/cameras_blender.py").read_text().split('r"""')[1].split('"""')[0])
    assert [d["name"] for d in blender["projectors"]] == [f"{frame.name} projector" for frame in scan.frames]
    place = np.array(blender["cameras"][2]["matrix"])[:3, 3]
    np.testing.assert_allclose(place * 1000, scan.poses.T_world_camera[2, :3, 3], rtol=1e-12)
    assert Path(blender["cameras"][2]["image"]) == scan.frames[2].image_path


def test_without_a_pose_folder_cameras_lie_beside_the_mesh_and_arbitrary_units_are_said(scan, tmp_path):
    files, unknown = {"cameras": ("blender",), "trajectory": ("tum",)}, replace(scan, units="arbitrary")
    text = exported(unknown, tmp_path / "mesh.glb", fill_holes=90.0, **files)
    assert {p.name for p in tmp_path.iterdir()} == {
        "mesh.glb", "cameras_blender.py", "camera_tum.txt", "projector_tum.txt",
    }  # fmt: skip
    assert "arbitrary units became one metre, so its size is not true" in text
    assert "closed 1 holes of up to 90 units" in text and "in the scan's arbitrary units" in text


def test_names_that_colmap_cannot_hold_are_refused_before_anything_is_computed(scan, tmp_path, monkeypatch):
    monkeypatch.setattr("sl_nerfstudio.runs.export.build_surface", lambda *_: pytest.fail("computed"))
    spaced = replace(scan.frames[0], image_path=scan.root / "images/my photo.png")
    with pytest.raises(UserError, match=r"'images/my photo.png' has a space"):
        exported(replace(scan, frames=(spaced, *scan.frames[1:])), tmp_path / "m.ply", cameras=("colmap",))


def test_colours_from_pictures_without_the_pattern(coloured, tmp_path):
    text = exported(coloured, tmp_path / "mesh.ply")
    data = vertex_data(tmp_path / "mesh.ply")
    rgb = np.stack([data["red"], data["green"], data["blue"]], 1)
    seen, grey = (rgb == COLOUR).all(1), (rgb == 128).all(1)
    assert (seen | grey).all() and 0.2 < seen.mean() < 0.8
    assert f"colours from 2 pictures without the pattern; {grey.mean():.1%} of the vertices" in text


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_a_texture_is_written_with_the_decimated_mesh_and_described(coloured, tmp_path, suffix):
    output = tmp_path / f"mesh{suffix}"
    text = exported(coloured, output, 64, texture=256, target_faces=2000, points=tmp_path / "p.ply")
    found = trimesh.load_mesh(output, process=False)
    material = found.visual.material
    image = (material.baseColorTexture if suffix == ".glb" else material.image).convert("RGB")
    assert image.size == (256, 256)
    assert {colour for _, colour in image.getcolors()} == {COLOUR, (128, 128, 128)}  # seen, or not seen
    mesh = read_mesh(output, "mm")
    assert len(found.faces) == len(mesh.faces) <= 2000 and off_ball(mesh.vertices).max() < 0.2
    assert "texture of 256 x 256 pixels, " in text and " charts, from 2 pictures without the pattern; " in text
    assert "% of the surface is in none of them and grey" in text and "colours from" not in text
    assert ((tmp_path / "mesh.png").exists(), (tmp_path / "mesh.mtl").exists()) == ((suffix == ".obj"),) * 2
    assert (trimesh.load(tmp_path / "p.ply").colors[:, :3] == COLOUR).all(1).any()  # points keep colours of their own


def test_a_texture_without_pictures_says_what_to_add(scan, tmp_path):
    with pytest.raises(UserError, match=r"has a picture without(.|\n)*--color(.|\n)*leave --texture"):
        exported(scan, tmp_path / "mesh.glb", texture=512)
    assert list(tmp_path.iterdir()) == []


def test_flags_that_cannot_be_are_all_named_before_anything_slow(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("run.yml", "old.ply", "refined/training.json", "colmap/images.txt", "mesh.mtl", "mesh.png"):
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text("mine")
    Path("folder.ply").mkdir()
    before = sorted(tmp_path.rglob("*"))
    new = ("--output", "new.ply")
    wrong = (
        "--watertight", "--keep-unobserved", "--fill-holes", -2, "--target-faces", 3, "--points", "cloud.xyz",
        "--resolution", 1, "--cameras", "colmap",
    )  # fmt: skip
    expect_refusals(
        main, "sl-export", ["--load-config", "run.yml"],
        ["--output", "new.stp"], ["--output", "old.ply"], [*new, "--poses", "refined"],
        ["--output", "folder.ply", "--overwrite"], ["--output", "old.ply/deeper/mesh.ply"],
        ["--output", "mesh.obj", *wrong], [*new, "--points", "new.ply"], [*new, "--texture", 2048],
        ["--output", "new.stl", "--texture", 2048], ["--output", "new.glb", "--texture", 63],
        ["--output", "mesh.obj", "--overwrite", "--texture", 8193], ["--output", "mesh.obj", "--texture", 512],
        [*new, "--poses", "new.ply/refined"], new, [*new, "--load-config", "missing.yml"],
    )  # fmt: skip
    assert sorted(tmp_path.rglob("*")) == before
    for flags in ({"output": Path("old.ply"), "overwrite": True}, {"output": Path("mesh.glb"), "texture": 64}):
        check_outputs(ExportConfig(Path("c"), **flags))
    check_outputs(ExportConfig(Path("c"), Path("new/deep/er.ply"), poses=Path("elsewhere/transforms.json")))
    with pytest.raises(UserError, match=r"--align plane and --poses: [\s\S]*remedy: export --poses by itself"):
        check_outputs(ExportConfig(Path("c"), Path("new.ply"), align="plane", poses=Path("elsewhere")))
