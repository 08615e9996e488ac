"""sl-export on a run of ns-train, and on runs that were moved, cut off or made by another method."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import tyro
import yaml

from sl_nerfstudio.cli.evaluate import EvalConfig, evaluate_scan
from sl_nerfstudio.cli.export import main
from sl_nerfstudio.cli.redecode import main as redecode
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import DeviceChange, IntrinsicsChange
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.meshing.files import read_mesh, read_quality
from sl_nerfstudio.runs.run import load_run
from sl_nerfstudio.scan import read_devices, read_poses, read_scan
from tests.dataparser.tiny_scan import RADIUS, TinyScan
from tests.model.training.small_runs import edited
from tests.test_ns_commands import train

from .snapshots import expect, masked, succeed

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]  # nerfstudio warns freely

S_WORLD_MM = Similarity(0.1, np.diag([1.0, -1.0, -1.0]), np.array([5.0, -2.5, 20.0]))  # cm, turned and shifted
CHECKPOINT = "nerfstudio_models/step-000000039.ckpt"


@pytest.fixture(scope="module")
def scan_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    scan = TinyScan(units="cm", S_world_mm=S_WORLD_MM, undecoded=0.05)
    return scan.write(tmp_path_factory.mktemp("scans") / "sphere")


@pytest.fixture(scope="module")
def config(scan_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with pytest.MonkeyPatch.context() as patch:
        yield train(patch, scan_root, tmp_path_factory.mktemp("outputs"), 40)


@pytest.fixture()
def copy(config: Path, tmp_path: Path) -> Path:
    """The run's folder, to be spoilt."""
    return Path(shutil.copytree(config.parent, tmp_path / "copy"))


def exported(*flags: object) -> str:
    return succeed(main, "sl-export", *flags).out


def test_surface_poses_and_record_of_a_run(config, scan_root, tmp_path, capsys):
    mesh_path, refined = tmp_path / "a mesh.ply", tmp_path / "refined"
    said = exported("--load-config", config, "--output", mesh_path, "--poses", refined, "--resolution", 64)
    mesh = read_mesh(mesh_path)
    off_mm = np.abs(np.linalg.norm(mesh.vertices - S_WORLD_MM.t, axis=1) / S_WORLD_MM.scale - RADIUS)
    assert np.median(off_mm) < 0.05 * RADIUS  # 40 steps; in wrong units or axes it would be off by 0.5 and more
    towards = (mesh.vertices - S_WORLD_MM.t) @ np.diag([1.0, -1.0, -1.0])
    assert towards[:, 2].max() > 3.5 > -2.5 > towards[:, 2].min() - 1  # cut at the back, which no frame saw
    quality = read_quality(mesh_path)
    assert quality is not None and len(quality.sigma) == len(mesh.vertices)
    seen = quality.views > 0
    assert seen.mean() > 0.9 and np.array_equal(seen, np.isfinite(quality.sigma))
    assert (quality.sigma[seen] >= quality.sigma_independent[seen]).all() and 0 < np.median(quality.sigma[seen]) < 1
    assert "uncertainty along the normal (1 sigma): " in said
    scan = read_scan(scan_root)
    found = read_poses(refined / "transforms.json", scan)
    np.testing.assert_allclose(found.T_world_camera[:, :3, 3], scan.poses.T_world_camera[:, :3, 3], atol=0.5)  # cm
    record = json.loads((refined / "training.json").read_text())
    assert record["settings"]["method_name"] == "sl-neus" and record["settings"]["step"] == 39
    assert record["settings"]["model"]["sdf"]["max_resolution"] == 64
    curves = record["curves"]
    assert curves["step"] == list(range(0, 40, 5)) and curves["loss"][-1] < 0.3 * curves["loss"][0]
    assert record["versions"]["torch"] == torch.__version__
    assert f"sl-eval --mesh '{mesh_path}' --data {scan_root} --poses {refined}/transforms.json" in said.replace(
        " \\\n     ", ""
    )
    assert " cm\n" in said
    measured(mesh_path, mesh.vertices[seen][[0, -1]], scan_root, refined, tmp_path)
    assert "Distances between points, in cm" in capsys.readouterr().out


def test_the_scan_of_a_run_is_decoded_again(config, scan_root, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    output = Path("again")
    flags = ("--load-config", config, "--output", output, "--resolution", 64)
    expect("sl-redecode", "run", masked(succeed(redecode, "sl-redecode", *flags).out))
    old, new = read_scan(scan_root), read_scan(output)
    np.testing.assert_array_equal(old.poses.stacked(), new.poses.stacked())
    for before, after in zip(old.frames, new.frames, strict=True):
        assert np.isfinite(after.read_coords()).sum() >= 0.9 * np.isfinite(before.read_coords()).sum()


def measured(mesh: Path, ends: np.ndarray, scan: Path, refined: Path, folder: Path) -> None:
    """`sl-eval --distance` of two vertices."""
    p, q = (",".join(map(str, end)) for end in ends.tolist())
    flags = ("--mesh", mesh, "--data", scan, "--poses", refined, "--json", folder / "eval.json", "--samples", 2000)
    evaluate_scan(tyro.cli(EvalConfig, args=[*map(str, flags), "--distance", f"across: {p} {q}"]))
    (length,) = json.loads((folder / "eval.json").read_text())["lengths"]
    assert length["length"] == pytest.approx(np.linalg.norm(ends[1] - ends[0]), rel=1e-4)
    assert 0 < length["sigma_shared"] < length["sigma"] < 2 and min(length["views"]) > 0


def test_a_run_with_changed_intrinsics_exports_them(scan_root, tmp_path, monkeypatch):
    change = IntrinsicsChange(DeviceChange(0.01, 0.0, -0.002), DeviceChange(-0.005, 0.001, 0.0))
    flags = ["sl-data"]
    for device, key in product(("camera", "projector"), ("focal", "x", "y")):
        flags += [f"--intrinsics-change.{device}.{key}", getattr(getattr(change, device), key)]
    config = train(monkeypatch, scan_root, tmp_path / "outputs", 2, *flags)
    scan, stated = read_scan(scan_root), (scan_root / "transforms.json").read_bytes()
    wanted = scan.with_intrinsics_change(change)
    refined = tmp_path / "refined"
    exported("--load-config", config, "--output", tmp_path / "m.ply", "--poses", refined, "--resolution", 32)
    found = read_devices(refined / "transforms.json", scan)
    assert found.projector == wanted.projector != scan.projector
    assert {frame.camera for frame in found.frames} == {frame.camera for frame in wanted.frames}
    record = json.loads((refined / "training.json").read_text())
    assert record["settings"]["intrinsics_change"] == asdict(change)
    assert record["intrinsics"]["change"] == asdict(change)
    assert (scan_root / "transforms.json").read_bytes() == stated


def test_a_moved_run_is_found_beside_its_config(config, tmp_path):
    moved = tmp_path / "moved"
    config.parent.rename(moved)
    try:
        assert load_run(moved).step == 39  # a folder will do
        assert load_run(moved / "config.yml").step == 39
    finally:
        moved.rename(config.parent)


def test_a_run_of_another_method(tmp_path):
    from nerfstudio.configs.method_configs import all_methods

    (tmp_path / "config.yml").write_text(yaml.dump(all_methods["nerfacto"]))
    with pytest.raises(
        UserError,
        match=r"line 1: nerfstudio.engine.trainer.TrainerConfig is not(.|\n)*not a run of sl-neus(.|\n)*ns-export",
    ):
        load_run(tmp_path)


def test_a_moved_scan_is_asked_for(copy, scan_root):
    def move(settings: Any) -> None:
        settings.pipeline.datamanager.data = settings.data = Path("/gone/for good")

    edited(copy, move)
    with pytest.raises(UserError, match=r"/gone/for good: has no transforms.json(.|\n)*moved(.|\n)*--data FOLDER"):
        load_run(copy)
    assert load_run(copy, scan_root).model.scan.root == scan_root
    with pytest.raises(UserError, match=r"elsewhere: has no transforms.json(.|\n)*mistyped"):
        load_run(copy, Path("elsewhere"))


def test_a_moved_scan_is_asked_for_by_nerfstudios_commands_too(copy, scan_root, capsys):
    """Their --load-config takes all settings from config.yml: what they say must work without it."""
    settings = yaml.load((copy / "config.yml").read_text(), Loader=yaml.Loader)
    dataparser = settings.pipeline.datamanager.dataparser
    for place in (settings, settings.pipeline.datamanager, dataparser):
        place.data = Path("/gone/for good")
    settings.last_step = 60
    with pytest.raises(SystemExit):
        settings.set_timestamp()  # ns-train
    said = capsys.readouterr().err
    assert said.startswith("error: /gone/for good: has no transforms.json") and "Traceback" not in said
    assert "remedy: with its folder: ns-train sl-neus --data FOLDER --load-dir" in said
    assert said.rstrip().endswith("--max-num-iterations 21")
    with pytest.raises(
        UserError, match=r"/gone/for good: has no transforms.json(.|\n)*ln -s NEW-PLACE '/gone/for good'"
    ):
        _ = dataparser.setup().loaded  # ns-eval, ns-render, ns-viewer


def without_checkpoint(run: Path) -> None:
    shutil.rmtree(run / "nerfstudio_models")
    edited(run, lambda settings: setattr(settings, "experiment_name", "another"))


def cut_off(run: Path) -> None:
    (run / CHECKPOINT).write_bytes((run / CHECKPOINT).read_bytes()[:1000])


def without_a_weight(run: Path) -> None:
    state = torch.load(run / CHECKPOINT)
    del state["pipeline"][next(key for key in state["pipeline"] if "mlp" in key)]
    torch.save(state, run / CHECKPOINT)


def otherwise_normalised(run: Path) -> None:
    """As by another version of this package."""
    stated = json.loads((run / "dataparser_transforms.json").read_text())
    (run / "dataparser_transforms.json").write_text(json.dumps({**stated, "scale": 1.01 * stated["scale"]}))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (without_checkpoint, r"no checkpoint step-\*.ckpt(.|\n)*interrupted(.|\n)*train again"),
        (cut_off, r"cannot be read as a checkpoint(.|\n)*truncated"),
        (without_a_weight, r"lacks 1 of the model's weights(.|\n)*another version"),
        (otherwise_normalised, r"has another place in the scene than in the training(.|\n)*version"),
    ],
)
def test_what_was_spoilt_is_named(copy, spoil, message):
    spoil(copy)
    with pytest.raises(UserError, match=message):
        load_run(copy)
