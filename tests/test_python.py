"""What Python programs see: names that exist and explain themselves, loaded when they are used; the examples."""

import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import sl_nerfstudio as sl
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.pattern.files import make_grid
from sl_nerfstudio.scan import read_scan
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.synthesise import synthesise
from tests.evaluation.shapes import ANYWHERE, bracket, scanned

ROOT = Path(__file__).parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


def run_example(number: int, *words: object) -> None:
    runpy.run_path(str(EXAMPLES[number - 1]))["main"](*map(str, words))


def test_the_import_loads_nothing_and_every_name_is_there_and_explained() -> None:
    heavy = "torch", "open3d", "nerfstudio", "numba", "scipy", "numpy"
    code = f"import sys, sl_nerfstudio; print([name for name in {heavy} if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"
    assert len(sl.__all__) == len(set(sl.__all__)) > 50
    for name in sl.__all__:
        assert (getattr(sl, name).__doc__ or "").strip(), name


def test_the_documentation_shows_every_example_and_names_every_function() -> None:
    text = (ROOT / "docs" / "python.md").read_text()
    assert all(f'--8<-- "examples/{path.name}"' in text and f"(../examples/{path.name})" in text for path in EXAMPLES)
    assert [name for name in sl.__all__ if name[0].islower() and f"`{name}`" not in text] == []
    assert all(15 <= len(path.read_text().splitlines()) <= 40 for path in EXAMPLES)


def test_rays_of_corresponding_pixels_meet_where_they_should() -> None:
    camera = Device(w=64, h=48, fl_x=90.0, fl_y=90.0, cx=32.0, cy=24.0)
    T_p = np.eye(4)
    T_p[:3, 3] = [10.0, 0.0, 0.0]
    p = np.array([[1.0, 2.0, -50.0], [-3.0, 4.0, -80.0]])
    u, v = ([90 * d[:, 0] / -d[:, 2] + 32, -90 * d[:, 1] / -d[:, 2] + 24] for d in (p, p - T_p[:3, 3]))
    found, sigma = sl.triangulate_pixels(camera, np.eye(4), np.stack(u, 1), camera, T_p, np.stack(v, 1))
    np.testing.assert_allclose(found, p, atol=1e-9)
    depth = np.linalg.norm(p, axis=1)
    np.testing.assert_allclose(sigma, depth**2 / (90 * 10), rtol=0.02)  # z^2 / (f b), near the axis


def test_devices_come_back_from_their_file(tmp_path: Path) -> None:
    camera = Device(w=64, h=48, fl_x=90.0, fl_y=91.0, cx=32.0, cy=24.0, k1=0.01)
    projector = Device(w=80, h=60, fl_x=70.0, fl_y=70.0, cx=40.0, cy=30.0, model="DOE")
    sl.write_devices(tmp_path / "intrinsics.json", camera, projector)
    assert sl.read_device_file(str(tmp_path / "intrinsics.json"), "camera", (64, 48)) == camera
    assert sl.read_device_file(tmp_path / "intrinsics.json", "projector", (80, 60)) == projector


def test_wrong_input_is_said_as_everywhere(tmp_path: Path) -> None:
    with pytest.raises(sl.UserError, match=r"2 images of .*, which a single one shows"):
        sl.decode_image([np.zeros((9, 9), np.uint8)] * 2, make_grid())
    with pytest.raises(sl.UserError, match=r"none\.json"):
        sl.decode_image(tmp_path / "a.png", tmp_path / "none.json")
    with pytest.raises(sl.UserError, match=r"train: poses: there is no such setting"):
        sl.train(tmp_path, tmp_path, poses="rigid-rig")


@pytest.mark.slow
def test_a_surface_is_compared_with_cad(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    sl.write_mesh(tmp_path / "part.stl", bracket(), units="mm")
    sl.write_mesh(tmp_path / "mesh.ply", scanned(bracket(), S=ANYWHERE), units="mm")
    run_example(5, tmp_path / "mesh.ply", tmp_path / "part.stl", "mm", 0.1)
    said = capsys.readouterr().out
    assert said.startswith("placed: 0.0") and "within 100.0%, out of tolerance 0.0%" in said


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("examples") / "captures"
    synthesise(SynthConfig(frames=6, resolution=300, images_only=True), folder)
    return folder


@pytest.mark.slow
def test_photographs_become_coordinates_points_and_a_scan(captures, tmp_path, capsys):
    run_example(1, captures / "images" / "frame_00000.png", captures / "pattern.json")
    assert " pixels decoded, " in capsys.readouterr().out
    run_example(2, captures, tmp_path / "cloud.npy")
    cloud = np.load(tmp_path / "cloud.npy")
    assert "registered: [True, True]" in capsys.readouterr().out
    assert cloud.shape[1] == 3 and np.isfinite(cloud).all()
    run_example(4, captures, tmp_path / "scan")
    assert len(read_scan(tmp_path / "scan").frames) >= 5


@pytest.mark.slow
def test_a_scan_becomes_a_mesh(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    synthesise(SynthConfig(frames=6, resolution=150), tmp_path / "scan")
    run_example(3, tmp_path / "scan", tmp_path / "runs", tmp_path / "mesh.ply", 60)
    said = capsys.readouterr().out
    assert len(sl.read_mesh(tmp_path / "mesh.ply").faces) > 1000 and "width: " in said
    with pytest.raises(sl.UserError, match="example"):  # a run of that name is there
        sl.train(tmp_path / "scan", tmp_path / "runs", name="example", steps=1)
