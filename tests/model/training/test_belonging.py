"""config.yml, scan and checkpoint of one run belong together; those of two do not, whatever opens them."""

import json
import os
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.scripts.viewer import run_viewer
from nerfstudio.utils.eval_utils import eval_setup

from sl_nerfstudio.cli.check import check_run_folder
from sl_nerfstudio.dataparser.dataparser import scan_fingerprint
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.runs.run import load_run
from sl_nerfstudio.scan import read_scan
from tests.model.training.small_runs import edited, folder_of, last_state, send, settings, status, train

pytestmark = pytest.mark.filterwarnings("ignore")  # nerfstudio warns freely


def fingerprint(root: Path) -> str:
    return scan_fingerprint(read_scan(root))


def move_pose(root: Path) -> None:
    content = json.loads((root / "transforms.json").read_text())
    content["frames"][1]["transform_matrix"][0][3] += 1e-6
    (root / "transforms.json").write_text(json.dumps(content))


def change_coordinate(root: Path) -> None:
    path = root / "coords/frame_00001.npz"
    with np.load(path) as file:
        values = {name: file[name].copy() for name in file.files}
    for value in values.values():
        value.flat[np.isfinite(value).reshape(-1).argmax()] += 0.25
    np.savez(path, **values)


def swap_frames(root: Path) -> None:
    one, two = root / "masks/frame_00000.png", root / "masks/frame_00001.png"
    one.rename(root / "third")
    two.rename(one)
    (root / "third").rename(two)


CHANGES = [move_pose, change_coordinate, swap_frames]


@pytest.mark.parametrize("change", CHANGES)
def test_a_changed_scan_is_refused_by_export_and_resume(scan_root, copy, tmp_path, capfd, change):
    changed = Path(shutil.copytree(scan_root, tmp_path / "sphere"))
    change(changed)
    assert fingerprint(changed) != fingerprint(scan_root)
    with pytest.raises(UserError, match=r"sphere: does not belong to this run, which was trained on another scan"):
        load_run(copy, changed)
    resumed = settings(changed, tmp_path / "new", load_dir=copy / "nerfstudio_models")
    assert status(train, resumed) == 1
    assert "sphere: does not belong to" in capfd.readouterr().err and not (tmp_path / "new").exists()


def test_a_scan_that_was_only_moved_is_taken(scan_root, copy, tmp_path):
    moved = Path(shutil.copytree(scan_root, tmp_path / "elsewhere"))
    for path in moved.rglob("*"):
        os.utime(path, (1, 1))
    assert fingerprint(moved) == fingerprint(scan_root)
    assert load_run(copy, moved).step == 11
    resumed = settings(moved, tmp_path / "new", steps=1, load_dir=copy / "nerfstudio_models")
    train(resumed)
    assert last_state(tmp_path / "new" / "elsewhere" / "sl-neus" / "first")["step"] == 12


def test_settings_that_were_edited_are_refused_unless_they_have_no_effect(copy):
    edited(copy, lambda config: setattr(config.pipeline.model, "eval_num_rays_per_chunk", 512))
    assert load_run(copy).step == 11
    edited(copy, lambda config: setattr(config.pipeline.model.losses, "eikonal", 0.3))
    for command in (load_run, check_run_folder):
        with pytest.raises(UserError, match=r"its settings are not those that the run was started with"):
            command(copy)


@pytest.fixture(scope="module")
def other_run(scan_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same scan with another seed: weights of the same shapes."""
    output = tmp_path_factory.mktemp("other")
    config = settings(scan_root, output, steps=1, schedule_iterations=12)
    config.machine.seed = 43
    train(config)
    return folder_of(output)


@pytest.mark.slow
def test_a_checkpoint_of_another_run_is_refused_by_every_command(copy, other_run, capfd):
    """As if a second training had been stopped after it wrote config.yml."""
    words = r"config.yml and the checkpoint of this run do not belong together: the settings"
    shutil.copy(other_run / "config.yml", copy / "config.yml")
    for command in (load_run, check_run_folder):
        with pytest.raises(UserError, match=words):
            command(copy)
    in_place = edited(copy, lambda config: vars(config).update(relative_model_dir=copy / "nerfstudio_models"))
    assert status(eval_setup, in_place) == 1  # ns-viewer, ns-eval, ns-render, ns-export
    error = capfd.readouterr().err
    assert error.startswith("error: config.yml and the checkpoint") and "Traceback" not in error


def test_sl_check_says_what_there_is(copy, scan_root, tmp_path):
    text = check_run_folder(copy)
    assert "no faults" in text and "step 11, complete" in text and f"{scan_root} is there and unchanged" in text
    edited(copy, lambda config: setattr(config.pipeline.datamanager, "data", tmp_path / "gone"))
    assert f"{tmp_path / 'gone'} is not there, so it was not compared" in check_run_folder(copy / "config.yml")
    checkpoint = copy / "nerfstudio_models/step-000000011.ckpt"
    torch.save([1, 2], checkpoint)
    with pytest.raises(UserError, match=r"cannot be read as a checkpoint \(it holds a list"):
        check_run_folder(copy)


@pytest.mark.parametrize("number, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_ns_viewer_ends_without_a_traceback(finished, monkeypatch, capfd, number, code):
    monkeypatch.setattr(run_viewer, "_start_viewer", lambda *_: send(number))
    viewer = run_viewer.RunViewer(load_config=finished / "config.yml")
    assert status(viewer.main) == code
    assert capfd.readouterr().err.strip().endswith(("interrupted", "terminated"))
