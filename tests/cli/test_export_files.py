"""Flags of sl-export for meshes of use and for files of other programs, with a ball whose field is known by formula."""

import json
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pycolmap
import pytest
import trimesh

from sl_nerfstudio.cli.export import ExportConfig, check_outputs, export_trained
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.evaluation.evaluate import read_inputs
from sl_nerfstudio.scan import Scan
from sl_nerfstudio.scan.images import encode_png
from tests.runs.ball_run import CENTRE, RADIUS, ball_scan, run_of


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    return ball_scan(tmp_path_factory.mktemp("export") / "scan")


def export(scan: Scan, output: Path, **flags) -> str:
    config = ExportConfig(Path("c"), output, resolution=48, **flags)
    check_outputs(config)
    return " ".join(export_trained(run_of(scan), config).split())  # long lines are broken where they need be


def vertex_data(path: Path) -> np.ndarray:
    return trimesh.load(path, process=False).metadata["_ply_raw"]["vertex"]["data"]


def test_every_file_at_once_and_other_programs_read_them(scan, tmp_path):
    text = export(
        scan, tmp_path / "mesh.obj", poses=tmp_path / "refined", points=tmp_path / "cloud.las",
        cameras=("colmap", "blender"), trajectory=("tum", "kitti"), target_faces=900,
    )  # fmt: skip
    names = {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()}
    colmap = {f"refined/colmap/{name}.txt" for name in ("cameras", "rigs", "frames", "images", "points3D")}
    assert names == colmap | {
        "mesh.obj", "mesh.mtl", "cloud.las", "refined/transforms.json", "refined/training.json",
        "refined/cameras_blender.py", "refined/camera_tum.txt", "refined/projector_tum.txt",
        "refined/camera_kitti.txt", "refined/projector_kitti.txt",
    }  # fmt: skip
    model = pycolmap.Reconstruction()
    model.read_text(str(tmp_path / "refined/colmap"))
    assert len(model.images) == 12 and model.compute_mean_reprojection_error() < 0.2
    points = np.array([p.xyz for p in model.points3D.values()])
    np.testing.assert_allclose(np.linalg.norm(points - CENTRE, axis=1), RADIUS, atol=0.05)  # the scan's unit, mm
    np.testing.assert_allclose(
        np.linalg.norm(laspy.read(tmp_path / "cloud.las").xyz - CENTRE / 1000, axis=1), RADIUS / 1000, atol=5e-5
    )
    times = np.loadtxt(tmp_path / "refined/camera_tum.txt")
    np.testing.assert_allclose(times[:, 1:4] * 1000, scan.poses.T_world_camera[:, :3, 3], atol=1e-6)
    assert len(trimesh.load_mesh(tmp_path / "mesh.obj").faces) <= 900
    assert "decimated from" in text and "COLMAP model in mm" in text and "in metres" in text


def test_without_a_pose_folder_cameras_lie_beside_the_mesh(scan, tmp_path):
    text = export(scan, tmp_path / "mesh.ply", cameras=("blender",), trajectory=("tum",))
    assert {p.name for p in tmp_path.iterdir()} == {
        "mesh.ply", "cameras_blender.py", "camera_tum.txt", "projector_tum.txt",
    }  # fmt: skip
    assert f"{tmp_path}: camera_tum.txt, projector_tum.txt" in text


def test_a_closed_solid_for_printing_says_what_it_invented(scan, tmp_path):
    text = export(scan, tmp_path / "solid.ply", watertight=True)
    solid = trimesh.load_mesh(tmp_path / "solid.ply", process=False)
    invented = vertex_data(tmp_path / "solid.ply")["invented"] > 0
    assert solid.is_watertight and solid.is_winding_consistent and "a closed solid" in text
    off = np.abs(np.linalg.norm(solid.vertices - CENTRE, axis=1) - RADIUS)
    assert off[~invented].max() < 0.02 and invented.mean() > 0.1
    lowest = solid.vertices[~invented, 2].min()
    cells = 2 / 48 * 60  # mm
    assert solid.vertices[:, 2].min() == pytest.approx(lowest - cells, abs=0.6)  # flat, a cell below what was seen
    share = solid.area_faces[invented[solid.faces].any(1)].sum() / solid.area
    assert f"{share:.0%} of the area is invented" in text


def test_a_solid_with_few_triangles_is_closed_and_in_millimetres(scan, tmp_path):
    export(scan, tmp_path / "print.stl", watertight=True, target_faces=600)
    solid = trimesh.load_mesh(tmp_path / "print.stl")
    assert solid.is_watertight and len(solid.faces) <= 600
    assert solid.extents[0] == pytest.approx(2 * RADIUS, rel=0.02)


def test_holes_are_filled_up_to_a_size_in_mm_and_marked(scan, tmp_path):
    """The ball lacks its lower side: a hole of about 60 mm. In a scan in cm it is as large."""
    text = export(scan, tmp_path / "open.ply", fill_holes=20.0)
    assert "closed 0 holes of up to 20 mm" in text and "holes that stay open: 1 that are larger" in text
    text = export(replace(scan, units="cm"), tmp_path / "cm.ply", fill_holes=90.0)
    assert "closed 0 holes" in text  # 60 cm
    text = export(scan, tmp_path / "filled.ply", fill_holes=90.0, target_faces=2000)
    data, mesh = vertex_data(tmp_path / "filled.ply"), trimesh.load_mesh(tmp_path / "filled.ply", process=False)
    invented = data["invented"] > 0
    assert "closed 1 holes of up to 90 mm" in text and mesh.is_watertight and 0.1 < invented.mean() < 0.4
    assert (data["z"][invented] < CENTRE[2] - 18).all() and (data["views"][invented] == 0).mean() > 0.9
    assert np.isfinite(data["sigma"][~invented]).mean() > 0.95


def test_keep_unobserved_marks_what_no_frame_saw(scan, tmp_path):
    text = export(scan, tmp_path / "all.ply", keep_unobserved=True)
    data = vertex_data(tmp_path / "all.ply")
    assert np.array_equal(data["invented"] > 0, data["views"] == 0) and "% of the area is invented" in text


def test_colours_from_pictures_without_the_pattern(scan, tmp_path):
    path = tmp_path / "red.png"
    picture = np.zeros((scan.frames[0].camera.h, scan.frames[0].camera.w, 3), np.uint8)
    picture[...] = (200, 30, 10)
    path.write_bytes(encode_png(picture))
    coloured = replace(scan, frames=(replace(scan.frames[0], color_path=path), *scan.frames[1:]))
    text = export(coloured, tmp_path / "mesh.ply", largest_component=True)
    data = vertex_data(tmp_path / "mesh.ply")
    rgb = np.stack([data["red"], data["green"], data["blue"]], 1)
    red, grey = (rgb == (200, 30, 10)).all(1), (rgb == 128).all(1)
    assert (red | grey).all() and 0.2 < red.mean() < 0.8 and "--largest-component removed 0 other pieces" in text
    assert f"colours from 1 pictures without the pattern; {grey.mean():.1%} of the vertices" in text


@pytest.mark.parametrize("suffix", [".glb", ".stl"])
def test_sl_eval_takes_the_mesh_back_into_the_scans_unit_and_axes(scan, suffix, tmp_path):
    text = export(scan, tmp_path / f"mesh{suffix}")
    assert ("written in metres; scaled from mm" if suffix == ".glb" else "written in millimetres (STL") in text
    found = read_inputs(tmp_path / f"mesh{suffix}", scan.root, None, None, 100, 0)
    np.testing.assert_allclose(np.linalg.norm(found.mesh.vertices - CENTRE, axis=1), RADIUS, atol=0.02)


def test_arbitrary_units_are_said(scan, tmp_path):
    unknown = replace(scan, units="arbitrary")
    assert "arbitrary units became one metre, so its size is not true" in export(unknown, tmp_path / "a.glb")
    assert "arbitrary units became one millimetre" in export(unknown, tmp_path / "a.stl", points=tmp_path / "p.las")
    text = export(unknown, tmp_path / "b.ply", fill_holes=90.0, trajectory=("kitti",), cameras=("blender",))
    assert "closed 1 holes of up to 90 units" in text and "in the scan's arbitrary units" in text


def test_contradictions_and_bad_values_are_all_said_at_once(tmp_path):
    (tmp_path / "colmap").mkdir()
    (tmp_path / "colmap/images.txt").write_text("mine")
    (tmp_path / "mesh.mtl").write_text("mine")
    config = ExportConfig(
        Path("c"), tmp_path / "mesh.obj", watertight=True, keep_unobserved=True, fill_holes=-2.0, target_faces=3,
        points=tmp_path / "cloud.xyz", resolution=1, cameras=("colmap",),
    )  # fmt: skip
    with pytest.raises(UserError) as raised:
        check_outputs(config)
    text = str(raised.value)
    for part in (
        "--watertight and --fill-holes contradict", "--watertight and --keep-unobserved contradict",
        "--keep-unobserved and --fill-holes contradict", "--fill-holes -2: must be a length greater than 0",
        "--target-faces 3: at least 4", "unknown kind of point cloud '.xyz'\n    remedy: end the name in .ply or .las",
        "--resolution 1", "colmap/images.txt: already exists", "mesh.mtl: already exists",
    ):  # fmt: skip
        assert part in text
    with pytest.raises(UserError, match=r"--points .*mesh.ply: is another output"):
        check_outputs(ExportConfig(Path("c"), tmp_path / "mesh.ply", points=tmp_path / "mesh.ply"))


def test_too_few_triangles_for_a_closed_solid(scan, tmp_path, monkeypatch):
    monkeypatch.setattr("sl_nerfstudio.meshing.mesh.Mesh.is_closed", lambda _: False)
    with pytest.raises(UserError, match=r"--target-faces 8: the surface is no longer closed(.|\n)*keep more triangles"):
        export(scan, tmp_path / "a.stl", watertight=True, target_faces=8)
    with pytest.raises(UserError, match=r"--watertight: the surface is not closed at --resolution 48(.|\n)*remedy"):
        export(scan, tmp_path / "a.stl", watertight=True)
    assert not (tmp_path / "a.stl").exists()


def test_the_script_for_blender_lists_every_frame(scan, tmp_path):
    export(scan, tmp_path / "mesh.ply", cameras=("blender",))
    text = (tmp_path / "cameras_blender.py").read_text()
    devices = json.loads(text.split('r"""')[1].split('"""')[0])
    assert [d["name"] for d in devices["projectors"]] == [f"{frame.name} projector" for frame in scan.frames]
    place = np.array(devices["cameras"][2]["matrix"])[:3, 3]
    np.testing.assert_allclose(place * 1000, scan.poses.T_world_camera[2, :3, 3], rtol=1e-12)
    assert Path(devices["cameras"][2]["image"]) == scan.frames[2].image_path


def test_names_that_colmap_cannot_hold_are_refused_before_anything_is_computed(scan, tmp_path, monkeypatch):
    monkeypatch.setattr("sl_nerfstudio.runs.export.build_surface", lambda *_: pytest.fail("computed"))
    spaced = replace(scan.frames[0], image_path=scan.root / "images/my photo.png")
    with pytest.raises(UserError, match=r"'images/my photo.png' has a space"):
        export(replace(scan, frames=(spaced, *scan.frames[1:])), tmp_path / "m.ply", cameras=("colmap",))
