"""nerfstudio's commands on a small scan: their entry points, called in this process to import nerfstudio only once."""

import copy
import json
import os
import re
import sys
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
import yaml
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.scripts import eval as ns_eval
from nerfstudio.scripts import exporter as ns_export
from nerfstudio.scripts import render as ns_render
from nerfstudio.scripts import train as ns_train
from nerfstudio.utils import writer
from nerfstudio.utils.eval_utils import eval_setup
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO, Viewer
from PIL import Image

from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.model.model import SLModel
from sl_nerfstudio.model.pipeline import SLPipeline
from tests.dataparser.tiny_scan import RADIUS, TinyScan

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]  # nerfstudio emits many warnings

SMALL = [
    *("--pipeline.model.sdf.max-resolution", "64", "--pipeline.datamanager.train-num-rays-per-batch", "256"),
    *("--pipeline.model.adjustment.other-minima", "False", "--pipeline.model.adjustment.further-searches", "False"),
    *("--logging.steps-per-log", "20", "--steps-per-eval-batch", "20"),
]
STEPS = 40


@pytest.fixture(autouse=True)
def _same_threads() -> Iterator[None]:
    """Opening a run in ns-export sets them for the rest of the process, here of the tests."""
    count = torch.get_num_threads()
    yield
    torch.set_num_threads(count)


@pytest.fixture(autouse=True)
def _fresh_writers() -> Iterator[None]:
    """nerfstudio keeps its log writers in a module; one command must not write to another's folder."""
    yield
    for event_writer in writer.EVENT_WRITERS:
        tensorboard = getattr(event_writer, "tb_writer", None)
        if tensorboard is not None:
            tensorboard.close()
    writer.EVENT_WRITERS.clear()
    writer.GLOBAL_BUFFER.clear()


def call(entry: Callable[[], Any], monkeypatch: pytest.MonkeyPatch, *arguments: object) -> None:
    monkeypatch.setattr(sys, "argv", ["ns-command", *map(str, arguments)])
    entry()


def train(monkeypatch: pytest.MonkeyPatch, root: Path, output: Path, steps: int, *more: object) -> Path:
    """Train and return the run's config.yml."""
    places = ("--data", root, "--output-dir", output)
    call(ns_train.entrypoint, monkeypatch, "sl-neus", *places, "--max-num-iterations", steps, *SMALL, *more)
    (config,) = output.glob("*/sl-neus/*/config.yml")
    return config


@pytest.fixture(scope="module")
def module_patch() -> Iterator[pytest.MonkeyPatch]:
    with pytest.MonkeyPatch.context() as patch:
        yield patch


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    S = Similarity(0.001, np.diag([1.0, -1.0, -1.0]), np.array([0.5, -0.25, 2.0]))
    return TinyScan(units="m", S_world_mm=S, undecoded=0.05).write(tmp_path_factory.mktemp("scans") / "sphere")


@pytest.fixture(scope="module")
def config(root: Path, tmp_path_factory: pytest.TempPathFactory, module_patch: pytest.MonkeyPatch) -> Path:
    return train(module_patch, root, tmp_path_factory.mktemp("outputs"), STEPS)


@pytest.fixture(scope="module")
def pipeline(config: Path) -> SLPipeline:
    loaded = eval_setup(config)[1]
    assert isinstance(loaded, SLPipeline)
    return loaded


def world(p_mm: np.ndarray) -> np.ndarray:
    return np.array([0.5, -0.25, 2.0]) + 0.001 * np.array([1, -1, -1]) * p_mm


def distance_to_sphere_mm(vertices: np.ndarray) -> np.ndarray:
    return np.abs(np.linalg.norm(vertices - world(np.zeros(3)), axis=1) * 1000 - RADIUS)


# ---- training


def test_training_saves_and_prints_the_next_commands(root, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    config = train(monkeypatch, root, tmp_path / "a folder", 3)
    assert [p.name for p in (config.parent / "nerfstudio_models").iterdir()] == ["step-000000002.ckpt"]
    settings = yaml.load(config.read_text(), Loader=yaml.Loader)
    assert settings.data == root and settings.data.is_absolute()
    assert settings.output_dir.is_absolute()  # so that every command works from any folder
    assert settings.pipeline.model.schedule_iterations == 3
    said, err = capfd.readouterr()
    short = config.relative_to(tmp_path)
    lines = said.replace(" \\\n     ", "").splitlines()  # long commands continue on the next line
    assert [line[:12].strip() for line in said.splitlines() if not line.startswith(" ")] == [
        "check", "adjust", "train", "result", "next:",
    ]  # fmt: skip
    assert f"  ns-viewer --load-config '{short}' --viewer.websocket-host 127.0.0.1" in lines
    assert f"  sl-export --load-config '{short}' --output mesh.ply --poses refined" in lines
    assert f"  sl-eval --mesh mesh.ply --data {root} --poses refined/transforms.json --report report.html" in lines
    assert len(said.splitlines()) <= 30
    # on a machine that is busy with other work, phases take so long that they report progress
    progress = re.compile(r"(check|adjust|train) +(\d+ of \d+.*|.* left|\d.* so far)")
    assert [line for line in err.splitlines() if not progress.fullmatch(line)] == []


def test_the_papers_method_trains(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    places = ("--data", root, "--output-dir", tmp_path)
    call(ns_train.entrypoint, monkeypatch, "sl-neus-paper", *places, "--max-num-iterations", 3, *SMALL)
    assert list(tmp_path.glob("*/sl-neus-paper/*/nerfstudio_models/step-000000002.ckpt"))
    (config,) = tmp_path.glob("*/sl-neus-paper/*/config.yml")
    model = eval_setup(config)[1].model
    assert isinstance(model, SLModel)
    cache = model.renderer.cache  # training samples whole rays and never fills it, but shadows are looked up in it
    p = torch.tensor([[0.0, 0.0, 0.0], [0.5, -0.4, 0.3], [-0.7, 0.2, 0.6]])
    with torch.no_grad():
        torch.testing.assert_close(cache.look_up(p), model.sdf(p), rtol=0, atol=2 * cache.cell)
    assert cache.look_up(p).abs().min() > 0.01


# ---- commands that use a result


@pytest.fixture
def export(config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Calls `ns-export` for one kind of file."""

    def run(kind: str, *flags: object) -> None:
        places = ("--load-config", config, "--output-dir", tmp_path)
        call(ns_export.entrypoint, monkeypatch, kind, *places, *flags)

    return run


def test_eval_writes_finite_json_about_held_out_pixels(config, tmp_path, monkeypatch) -> None:
    def no_constants(name: str) -> None:
        raise AssertionError(f"{name} is not JSON")

    outputs = ("--output-path", tmp_path / "out.json", "--render-output-path", tmp_path / "images")
    call(ns_eval.entrypoint, monkeypatch, "--load-config", config, *outputs)
    results = json.loads((tmp_path / "out.json").read_text(), parse_constant=no_constants)["results"]
    assert results["coordinate_px"] < 3 and results["coordinate_px_std"] >= 0
    assert {p.name.split("_")[1] for p in (tmp_path / "images").iterdir()} == {"00000", "00001", "00002"}


def test_export_pointcloud_in_the_scans_units(export, tmp_path) -> None:
    export("pointcloud", "--num-points", 1000, "--num-rays-per-batch", 2000, "--save-world-frame", True)
    cloud = trimesh.load(tmp_path / "point_cloud.ply")
    assert np.median(distance_to_sphere_mm(np.asarray(cloud.vertices))) < 2


def test_export_tsdf(export, tmp_path, pipeline) -> None:
    export("tsdf", "--resolution", 48, "--downscale-factor", 1, "--texture-method", "tsdf")
    mesh = trimesh.load(tmp_path / "tsdf_mesh.ply")
    S = pipeline.datamanager.dataparser.loaded.S_scene_world.inverse()
    # half of the mesh is the unobserved inside of nerfstudio's volume; the sphere must be in it
    assert (distance_to_sphere_mm(S.points(np.asarray(mesh.vertices))) < 3).mean() > 0.3


def test_export_cameras_gives_the_refined_poses(export, tmp_path, pipeline) -> None:
    export("cameras")
    refined = pipeline._sl_model.poses_scene()[0]
    for name in ("transforms_train.json", "transforms_eval.json"):
        frames = json.loads((tmp_path / name).read_text())
        np.testing.assert_allclose([f["transform"] for f in frames], refined[:, :3].numpy(), atol=1e-5)


def test_export_marching_cubes_finds_what_it_needs(pipeline: SLPipeline, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command itself needs CUDA on any machine; these are the two attributes of a model that it uses."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert hasattr(pipeline.model.config, "sdf_field")
    p = torch.rand(100, 3) * 2 - 1
    torch.testing.assert_close(pipeline._sl_model.field.forward_geonetwork(p)[:, 0], pipeline._sl_model.sdf(p))


@pytest.mark.skipif(torch.cuda.is_available(), reason="the refusal is for machines without a GPU")
def test_export_marching_cubes_ends_in_a_sentence_without_a_gpu(export, capfd) -> None:
    with pytest.raises(SystemExit) as end:
        export("marching-cubes")
    err = capfd.readouterr().err
    assert end.value.code == 1 and len(err.splitlines()) == 1
    assert err.startswith("error: ns-export marching-cubes needs a GPU") and "sl-export --load-config" in err


def test_export_poisson(export, tmp_path) -> None:
    """The default, `--texture-method nerf`: the whole texture is drawn, and its colours are those of the surface."""
    sizes = ("--num-points", 1000, "--num-rays-per-batch", 2000, "--target-num-faces", 500, "--num-pixels-per-side", 64)
    export("poisson", *sizes)
    assert len(trimesh.load(tmp_path / "poisson_mesh.ply").faces) > 500
    mesh = trimesh.load(tmp_path / "mesh.obj")
    assert 100 < len(mesh.faces) <= 500
    texture = np.asarray(Image.open(tmp_path / "material_0.png"))
    uv = np.asarray(mesh.visual.uv)
    column, row = (uv[:, 0] * 64).astype(int).clip(0, 63), ((1 - uv[:, 1]) * 64).astype(int).clip(0, 63)
    # Shaded, not the black of rays that see nothing; where Poisson bridges what no frame saw, there is nothing to see.
    assert (texture[row, column].max(-1) > 0).mean() > 0.8


def test_trajectories_are_rendered_where_ffmpeg_is(config, tmp_path, monkeypatch, pipeline) -> None:
    """With a stand-in for ffmpeg: images are written without it, but nerfstudio asks for it first."""
    (tmp_path / "ffmpeg").touch(mode=0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    T = pipeline._sl_model.poses_scene()[0][1]
    path = {
        "camera_type": "perspective", "render_height": 20, "render_width": 24, "seconds": 1,
        "camera_path": [{"camera_to_world": T.flatten().tolist(), "fov": 30, "aspect": 1.2}] * 2,
    }  # fmt: skip
    (tmp_path / "path.json").write_text(json.dumps(path))
    flags = ["--output-path", tmp_path / "way", "--camera-path-filename", tmp_path / "path.json"]
    flags += ["--rendered-output-names", "coordinates", "pattern", "--output-format", "images", "--image-format", "png"]
    call(ns_render.entrypoint, monkeypatch, "camera-path", "--load-config", config, *flags)
    image = np.asarray(Image.open(tmp_path / "way" / "00000.png")).astype(int)
    coordinates, pattern = np.split(image, 2, axis=1)
    seen = coordinates.any(-1)
    assert seen.mean() > 0.1
    assert (abs(coordinates[seen][:, 2] - 51) <= 1).all()  # blue marks what has a coordinate; red and green are x and y
    assert (pattern[..., 0] == pattern[..., 1]).all() and (pattern[..., 0] == pattern[..., 2]).all()


def test_render_dataset(config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flags = ("--output-path", tmp_path, "--split", "train+test", "--downscale-factor", 2, "--image-format", "png")
    call(ns_render.entrypoint, monkeypatch, "dataset", "--load-config", config, *flags)
    for split in ("train", "test"):
        for output in ("gt-rgb", "rgb", "depth", "normals", "accumulation", "coordinates", "pattern", "residual"):
            assert Image.open(tmp_path / split / output / "frame_00001.png").size == (24, 20)
        assert not (tmp_path / split / "coordinate_x").exists()  # pattern pixels are no picture


# ---- the viewer


@pytest.fixture(scope="module")
def viewer(pipeline: SLPipeline, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Viewer]:
    settings = ViewerConfig(websocket_host="127.0.0.1")
    log = tmp_path_factory.mktemp("viewer") / "viewer.log"
    viewer = Viewer(settings, log, pipeline.datamanager.get_datapath(), pipeline)
    viewer.init_scene(pipeline.datamanager.train_dataset, "completed")
    yield viewer
    viewer.viser_server.stop()


def test_viewer_shows_cameras_and_projectors_before_and_after(viewer: Viewer, pipeline: SLPipeline) -> None:
    """In nerfstudio's own viewer; tests/model/viewer has the rest."""
    port = viewer.viser_server.get_port()
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=10) as page:
        assert page.status == 200
    devices = pipeline.scene_view._devices
    loaded = pipeline.datamanager.dataparser.loaded
    start = loaded.S_scene_world.poses(loaded.scan.poses.stacked()).reshape(2, -1, 4, 4)
    refined = [T.numpy() for T in pipeline._sl_model.poses_scene()]
    for nodes, before, after in zip(devices, start, refined, strict=True):
        for handles, T in ((nodes.starting, before), (nodes.refined, after)):
            positions = [h.position for h in handles]
            np.testing.assert_allclose(positions, T[:, :3, 3] * VISER_NERFSTUDIO_SCALE_RATIO, atol=1e-4)
    assert not viewer.control_panel.layer_depth


def test_viewer_moves_the_captured_images_with_the_poses(viewer, pipeline, monkeypatch) -> None:
    camera, projector = (T.double().numpy() for T in pipeline._sl_model.poses_scene())
    moved = camera.copy()
    moved[:, 0, 3] += 1
    monkeypatch.setattr(pipeline.scene_view, "_numpy_poses", lambda: (moved, projector))
    pipeline.scene_view.update(force=True)
    positions = [viewer.camera_handles[i].position for i in range(3)]
    np.testing.assert_allclose(positions, moved[:, :3, 3] * 10, atol=1e-4)


def test_every_output_can_be_shown(pipeline: SLPipeline) -> None:
    """The viewer supports only floats of one or three channels, and uses cameras that are not those of a frame."""
    cameras = copy.deepcopy(pipeline.datamanager.train_dataset.cameras[0:1])
    cameras.metadata = {"cam_idx": 0}
    outputs = pipeline.model.eval().get_outputs_for_camera(cameras)
    assert {"rgb", "depth", "accumulation", "normals", "coordinates", "pattern", "residual"} <= set(outputs)
    for name, image in outputs.items():
        assert image.dtype == torch.float32 and image.shape in {(40, 48, 1), (40, 48, 3)}, name
        assert image.isfinite().all(), name
