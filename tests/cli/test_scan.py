"""sl-scan: one command, interrupted, repeated, and with other flags; with trainings of a few steps."""

import json
import os
import shutil
import signal
import socket
import threading
import time
from pathlib import Path

import msgspec
import numpy as np
import pytest
import trimesh
from nerfstudio.scripts import train as ns_train
from scipy.spatial import KDTree
from scipy.spatial.distance import pdist
from viser._messages import ViewerCameraMessage
from websockets.sync.client import connect

from sl_nerfstudio.cli import scan as module
from sl_nerfstudio.cli.scan import ScanConfig, main
from sl_nerfstudio.meshing.files import read_colour, read_mesh, read_quality
from sl_nerfstudio.model import preview
from sl_nerfstudio.model.loop import SLTrainer
from sl_nerfstudio.model.preview import Preview
from sl_nerfstudio.scan import read_poses, read_scan
from sl_nerfstudio.scan.images import encode_png, read_image
from tests.processing.gray_scan import GrayScan, make_gray_scan
from tests.test_ns_commands import _fresh_writers  # noqa: F401 (nerfstudio's log writers are global)

from .snapshots import call, expect_refusals, succeed

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]  # nerfstudio warns freely

STEPS = 12
LENGTH = ("--known-length", "baseline of frame pose 1 = 85 mm")


@pytest.fixture(scope="module", autouse=True)
def quick():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_STEPS", {"draft": STEPS, "normal": STEPS + 1, "fine": STEPS + 2})
        patch.setattr(module, "_CELLS", dict.fromkeys(module._CELLS, 64))
        patch.setenv("SL_CACHE", os.devnull)
        yield


@pytest.fixture(scope="module")
def captures(tmp_path_factory) -> GrayScan:
    return make_gray_scan(tmp_path_factory.mktemp("captures"))


def words(captures: GrayScan, output: Path, *flags: object) -> list[object]:
    return [captures.root / "images", *captures.flags[2:], "--output", output, "--quality", "draft", *flags]


@pytest.fixture(scope="module")
def done(captures, tmp_path_factory) -> tuple[Path, str]:
    """A complete result, and what was said."""
    root = tmp_path_factory.mktemp("done") / "result"
    said = succeed(main, "sl-scan", *words(captures, root)).out
    return root, said.replace(str(root), "RESULT").replace(str(captures.root), "CAPTURES")


@pytest.fixture
def result(done, captures, tmp_path, monkeypatch) -> Path:
    """A copy of the result, as if its folder had been moved; a training fails."""
    monkeypatch.setattr(ns_train, "main", lambda _: pytest.fail("trained again"))
    return Path(shutil.copytree(done[0], tmp_path / "result"))


def times(root: Path) -> dict[str, int]:
    return {str(path): path.stat().st_mtime_ns for path in root.rglob("*.*") if path.is_file()}


def expect_same_mesh(made: Path, wanted: Path) -> None:
    """The same triangles and colours; what some vertices are worth may differ by a ray that grazes an edge."""
    (a, b), (quality, other) = map(read_mesh, (made, wanted)), map(read_quality, (made, wanted))
    np.testing.assert_array_equal(a.faces, b.faces)
    np.testing.assert_array_equal(read_colour(made), read_colour(wanted))
    np.testing.assert_allclose(a.vertices, b.vertices, rtol=1e-9)
    for name, values in vars(other).items():
        differ = ~np.isclose(getattr(quality, name), values, rtol=1e-5, equal_nan=True)
        assert differ.mean() < 1e-3, (name, getattr(quality, name)[differ], values[differ])


def test_photographs_become_a_mesh_with_a_verdict(done):
    root, said = done
    stages = [line for line in said.splitlines() if line.startswith("-- ")]
    assert stages == ["-- process --", "-- train --", "-- export --", "-- evaluate --"]
    assert "verdict on the photographs: good" in said and "wrote 4 of 4 frames to RESULT/scan" in said
    assert said.index("--quality draft --known-length 'baseline of frame pose 0") < said.index("ns-viewer")
    assert "ns-train" not in said  # what is better is the same command, with more quality
    mesh, scan = read_mesh(root / "mesh.ply"), read_scan(root / "scan")
    assert len(mesh.faces) > 100 and scan.units == "arbitrary"
    web = trimesh.load_mesh(root / "mesh.glb", process=False)
    assert len(web.faces) == len(mesh.faces)
    assert len(read_poses(root / "poses/transforms.json", scan).T_world_camera) == 4
    figures = json.loads((root / "evaluation.json").read_text())
    assert f"verdict: {figures['verdict']}\n" in said and "<title>Scan report: " in (root / "report.html").read_text()
    colours = trimesh.load(root / "mesh.ply", process=False).visual.vertex_colors[:, :3]
    assert len(np.unique(colours, axis=0)) > 20  # of the images in full light
    assert figures["verdict"] != "good"  # few steps


def test_the_same_again_does_nothing(done, captures):
    root, before = done[0], times(done[0])
    said = succeed(main, "sl-scan", *words(captures, root)).out
    assert [line.split(":")[0] for line in said.splitlines() if line.startswith("--")] == [
        "-- process", "-- train", "-- export", "-- evaluate"]  # fmt: skip
    assert times(root) == before
    assert f"verdict: {json.loads((root / 'evaluation.json').read_text())['verdict']}\n" in said


def test_a_length_that_is_added_later_takes_no_training(result, captures):
    before = read_mesh(result / "mesh.ply")
    said = succeed(main, "sl-scan", *words(captures, result, *LENGTH)).out
    assert "lengths in mm (baseline of frame pose 1)" in said and "-- train: as before" in said
    scan = read_scan(result / "scan")
    assert read_poses(result / "poses/transforms.json", scan).baseline[1] == pytest.approx(85, rel=1e-9)
    after = read_mesh(result / "mesh.ply")
    growth = np.ptp(after.vertices, axis=0) / np.ptp(before.vertices, axis=0)
    assert growth.min() > 10 and np.ptp(growth) < 0.01 * growth.min()
    assert json.loads((result / "evaluation.json").read_text())["units"] == "mm"


def test_colours_that_are_added_later_take_no_training(result, captures, tmp_path):
    folder, wanted = tmp_path / "colours", np.array([200, 120, 60], dtype=np.uint8)
    folder.mkdir()
    for k in range(3):
        (folder / f"pose {k}.png").write_bytes(encode_png(np.full((160, 160, 3), wanted)))
    said = succeed(main, "sl-scan", *words(captures, result, "--color", folder)).out
    assert "colours from 3 photographs without the pattern (3 png); none of pose 3" in said
    colours = trimesh.load(result / "mesh.ply", process=False).visual.vertex_colors[:, :3].astype(int)
    assert (np.abs(colours - wanted).max(1) <= 1).mean() > 0.8
    scan = read_scan(result / "scan")
    assert [frame.color_path is not None for frame in scan.frames] == [True, True, True, False]


def test_an_interrupted_training_goes_on_and_ends_with_the_same(done, captures, tmp_path, monkeypatch):
    step = SLTrainer.train_iteration

    def interrupted(self, number):
        if number == STEPS // 2:
            os.kill(os.getpid(), signal.SIGINT)
        return step(self, number)

    output = tmp_path / "r"
    with monkeypatch.context() as patch:
        patch.setattr(SLTrainer, "train_iteration", interrupted)
        ended = call(main, "sl-scan", *words(captures, output))
    assert ended.status == 130 and not (output / "mesh.ply").exists()
    command = f"sl-scan {captures.root}/images --output {output} --pattern {captures.root}/pattern.json"
    assert f"to go on: {command}" in ended.err and "Traceback" not in ended.err
    said = succeed(main, "sl-scan", *words(captures, output)).out
    assert "-- process: as before" in said and f"goes on after step {STEPS // 2}" in " ".join(said.split())
    expect_same_mesh(output / "mesh.ply", done[0] / "mesh.ply")
    assert (output / "mesh.glb").read_bytes() == (done[0] / "mesh.glb").read_bytes()


def test_a_scan_folder_begins_with_the_training_and_another_quality_is_another_run(done, tmp_path):
    scan, output = Path(shutil.copytree(done[0] / "scan", tmp_path / "scan")), tmp_path / "result"
    said = succeed(main, "sl-scan", scan, "--output", output, "--quality", "draft").out
    assert "-- process" not in said and (output / "report.html").exists() and not (output / "scan").exists()
    assert (output / "mesh.glb").read_bytes() == (done[0] / "mesh.glb").read_bytes()
    assert len(list((output / "training/sl-neus").iterdir())) == 1
    assert ScanConfig(scan, output, quality="draft").better.quality == "normal"


class Browser(threading.Thread):
    """Connects to a preview as a browser does, and notes all that it gets until the connection ends."""

    def __init__(self, preview: Preview) -> None:
        super().__init__(daemon=True)
        self.port, self.got = preview.server.get_port(), []
        self.start()
        while not preview.server.get_clients():
            time.sleep(0.01)

    def run(self) -> None:
        eye = ViewerCameraMessage((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 5.0), 1.0, 1.5, (0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
        with connect(f"ws://127.0.0.1:{self.port}", max_size=None) as connection:
            connection.send(msgspec.msgpack.encode(eye.as_serializable_dict()))
            for window in connection:
                self.got += msgspec.msgpack.decode(window)

    def of(self, kind: str) -> dict[str, dict]:
        """The last message of a kind about each node."""
        return {message["name"]: message for message in self.got if message["type"] == kind}


def test_a_preview_shows_frames_and_surface_ends_with_the_command_and_changes_nothing(
    done, captures, tmp_path, monkeypatch
):
    open_preview, browsers = module._opened_preview, []

    def opened(config):
        browsers.append(Browser(found := open_preview(config)))
        return found

    monkeypatch.setattr(module, "_opened_preview", opened)
    monkeypatch.setattr(preview, "_TRAINING_PER_DRAWING", 0)  # the surface after every step
    output = tmp_path / "r"
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        monkeypatch.setattr(preview, "PORT", port)
        said = succeed(main, "sl-scan", *words(captures, output, "--preview")).words
    (browser,) = browsers
    assert browser.port > port
    assert f" 127.0.0.1:{browser.port} (open it" in said and f"port {port} is in use by another program" in said
    browser.join(10)
    assert not browser.is_alive()
    with pytest.raises(OSError):
        socket.create_connection(("127.0.0.1", browser.port))

    names = [f"pose {k}" for k in range(4)]
    words_shown = [str(m["updates"]) for m in browser.got if m["type"] == "GuiUpdateMessage"]
    assert [
        any(text in shown for shown in words_shown)
        for text in ("4 of 4 frames registered", "4 of 4 frames adjusted together", f"training, step {STEPS - 1}")
    ] == [True] * 3
    clouds = {name: np.frombuffer(m["points"], np.float32).reshape(-1, 3)
              for name, m in browser.of("PointCloudMessage").items()}  # fmt: skip
    assert sorted(clouds) == [f"/points/{name}" for name in names]
    assert all(500 < len(points) <= preview._MOST_OF_A_FRAME for points in clouds.values())
    first, *others = clouds.values()
    assert np.median(KDTree(np.concatenate(others)).query(first)[0]) < 0.02 * np.ptp(first, axis=0).max()
    assert set(browser.of("CameraFrustumMessage")) == {
        f"/{kind}s/{n}" for kind in ("camera", "projector") for n in names
    }
    at = browser.of("SetPositionMessage")
    poses = read_poses(output / "poses/transforms.json", read_scan(output / "scan"))
    for kind, T in (("camera", poses.T_world_camera), ("projector", poses.T_world_projector)):
        ratio = pdist([at[f"/{kind}s/{name}"]["position"] for name in names]) / pdist(T[:, :3, 3])
        np.testing.assert_allclose(ratio, ratio[0], rtol=1e-4)
    surface = browser.of("MeshMessage")["/surface"]
    assert len(surface["faces"]) > 1000

    for kind in ("mesh.glb", "poses/*.npz", "poses/transforms.json", "scan/**/*.npz", "training/**/*.ckpt"):
        made, plain = ({path.name: path.read_bytes() for path in root.glob(kind)} for root in (output, done[0]))
        assert made and [name for name in made | plain if made.get(name) != plain.get(name)] == []
    expect_same_mesh(output / "mesh.ply", done[0] / "mesh.ply")


def test_what_cannot_be_is_refused(done, result, captures, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(captures.root, tmp_path, dirs_exist_ok=True)
    Path("scan").symlink_to(done[0] / "scan")
    Path("mine").mkdir()
    Path("mine/notes.txt").write_text("mine")
    for folder, size in (("small", 80), ("captures", 0)):
        Path(folder).mkdir()
        picture = encode_png(np.full((size, size, 3), 9, dtype=np.uint8)) if size else None
        Path(folder, "pose 0.png").write_bytes(picture or (captures.root / "images/pose 0/0.png").read_bytes())
    Path("others").mkdir()
    Path("others/IMG_1.jpg").write_bytes(b"")
    usual = ("images", "--pattern", "pattern.json", "--intrinsics", "intrinsics.json")
    expect_refusals(
        main, "sl-scan", (),
        ("images", "--output", "r"),
        ("imagse", "--output", "r"),
        ("scan", "--output", "r", "--pattern", "pattern.json", "--known-length", "baseline of frame 0 = 85 mm"),
        (*usual, "--output", "images/r"),
        (*usual, "--output", "mine"),
        (*usual, "--output", "r", "--color", "small"),
        (*usual, "--output", "r", "--color", "captures"),
        (*usual, "--output", "r", "--color", "others"),
        (*usual, "--output", "r", "--known-length", "baseline of frame 9 = 85 mm"),
    )  # fmt: skip
    assert Path("mine/notes.txt").read_text() == "mine" and [p.name for p in Path("mine").iterdir()] == ["notes.txt"]


def test_a_mesh_that_another_program_changed_is_not_overwritten(result, captures):
    (result / "mesh.ply").write_bytes(b"ply, edited")
    ended = call(main, "sl-scan", *words(captures, result, *LENGTH))
    assert ended.status == 1 and "mesh.ply: would be overwritten" in ended.err and "remedy: move it" in ended.err
    assert (result / "mesh.ply").read_bytes() == b"ply, edited"
    (result / "mesh.ply").unlink()
    succeed(main, "sl-scan", *words(captures, result, *LENGTH))
    assert read_image(result / "scan/images/pose 0.png").shape == (160, 160)


def test_interrupted_in_any_other_stage_it_says_how_to_go_on(result, captures, monkeypatch):
    (result / "report.html").unlink()

    def interrupted(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("sl_nerfstudio.cli.evaluate.evaluate_scan", interrupted)
        ended = call(main, "sl-scan", *words(captures, result))
    assert ended.status == 130 and "to go on: sl-scan " in ended.err
    signal.signal(signal.SIGINT, signal.default_int_handler)
    succeed(main, "sl-scan", *words(captures, result))
    assert (result / "report.html").exists()
