"""A run's folder: nothing in it is overwritten, one process writes to it, and a run can be continued in it."""

import os
import signal
import time
from copy import deepcopy as copy_of
from pathlib import Path

import pytest

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.methods import sl_neus_paper
from sl_nerfstudio.model.run_files import LOCK, take_folder
from tests.forks import exit_status, fork
from tests.model.training.small_runs import (
    content,
    folder_of,
    go_on,
    last_state,
    require_equal,
    settings,
    status,
    train,
)

pytestmark = pytest.mark.filterwarnings("ignore")  # nerfstudio warns freely


def test_a_finished_run_is_not_overwritten(scan_root, finished, capfd):
    before = content(finished)
    assert status(train, settings(scan_root, finished.parents[2])) == 1
    assert content(finished) == before
    error = capfd.readouterr().err
    assert f"{finished}: holds another run (its last checkpoint is step-000000011.ckpt), and nothing was" in error
    assert "choose another name with --timestamp" in error
    assert f"ns-train sl-neus --load-config {finished}/config.yml" in error
    assert f"--load-dir {finished}/nerfstudio_models" in error


def test_a_begun_run_and_a_folder_of_something_else_are_not_overwritten(scan_root, tmp_path, capfd):
    for file, words in (("config.yml", "it has no checkpoint yet"), ("notes.txt", "is not empty (it holds notes.txt)")):
        folder = folder_of(tmp_path / file)
        folder.mkdir(parents=True)
        (folder / file).write_text("mine")
        assert status(train, settings(scan_root, tmp_path / file)) == 1
        assert content(folder) == {file: b"mine"} and words in capfd.readouterr().err


@pytest.mark.slow
def test_a_folder_that_a_killed_process_left_empty_is_used(scan_root, tmp_path):
    folder = folder_of(tmp_path)
    folder.mkdir(parents=True)
    (folder / LOCK).write_text("123")
    (folder / ".checkpoint.partial").write_text("half")
    train(settings(scan_root, tmp_path, steps=1))
    assert not list(folder.glob("*.partial")) and last_state(folder)["step"] == 0


@pytest.mark.slow
def test_a_run_whose_schedule_has_ended_is_trained_further_as_if_it_had_not_stopped(scan_root, finished, tmp_path):
    """Its checkpoint holds no moments of the optimisers, because a longer run forgets them there, too."""
    assert not any(part["state"] for part in last_state(finished)["optimizers"].values())
    train(settings(scan_root, tmp_path, "whole", steps=16, schedule_iterations=12))
    whole = last_state(folder_of(tmp_path, "whole"))
    assert all(part["state"] for part in whole["optimizers"].values())
    train(settings(scan_root, tmp_path, "rest", steps=4, load_dir=finished / "nerfstudio_models"))
    require_equal(last_state(folder_of(tmp_path, "rest")), whole)


@pytest.mark.slow
def test_the_papers_method_is_trained_further(scan_root, tmp_path):
    """Its learning rates end before its annealing does."""
    for more in ({}, {"load_dir": tmp_path / "sphere/sl-neus-paper/first/nerfstudio_models"}):
        config = copy_of(sl_neus_paper.config)
        config.data, config.output_dir, config.timestamp, config.max_num_iterations = scan_root, tmp_path, "first", 2
        config.pipeline.model.sdf.log2_table_size = 10
        config.schedule_iterations = None if more else 9000
        config.load_dir = more.get("load_dir")
        train(config)
    assert last_state(tmp_path / "sphere/sl-neus-paper/first")["schedule_iterations"] == 9000


def test_it_is_not_trained_further_with_other_settings(scan_root, finished, capfd):
    before = content(finished)
    further = settings(scan_root, finished.parents[2], load_dir=finished / "nerfstudio_models")
    further.pipeline.model.losses.eikonal = 0.2
    assert status(train, further) == 1
    assert content(finished) == before
    assert "holds a run with other settings, and nothing was changed" in capfd.readouterr().err


@pytest.mark.slow
def test_it_branches_off_into_another_folder(scan_root, finished, tmp_path):
    """There, settings may change, and its checkpoint belongs to the new config.yml."""
    other = settings(scan_root, tmp_path, "other", steps=2, load_dir=finished / "nerfstudio_models")
    other.pipeline.model.losses.eikonal = 0.2
    before = content(finished)
    train(other)
    assert content(finished) == before
    state = last_state(folder_of(tmp_path, "other"))
    wanted = bytes.fromhex(other.pipeline.settings_fingerprint)
    assert state["step"] == 13 and bytes(state["pipeline"]["settings_fingerprint"].tolist()) == wanted


@pytest.mark.slow
def test_an_earlier_checkpoint_does_not_continue_where_a_later_one_is(scan_root, tmp_path, capfd):
    train(settings(scan_root, tmp_path, steps=5, steps_per_save=2, save_only_latest_checkpoint=False))
    models = folder_of(tmp_path) / "nerfstudio_models"
    (models / "step-notes.ckpt").write_text("mine")
    further = settings(scan_root, tmp_path, steps=5, load_dir=models, load_step=2)
    assert status(train, further) == 1
    assert "step-000000004.ckpt is there, too" in capfd.readouterr().err
    train(settings(scan_root, tmp_path, steps=5, load_dir=models))  # foreign names count for nothing, and stay
    assert {path.name for path in models.iterdir()} == {"step-000000009.ckpt", "step-notes.ckpt"}


def test_a_complete_run_is_not_continued(finished, capfd):
    before = content(finished)
    assert status(go_on, finished / "config.yml") == 1
    assert content(finished) == before
    error = capfd.readouterr().err
    assert "this run is complete, at step 11" in error
    assert f"--load-dir {finished}/nerfstudio_models" in error and "--timestamp first" in error


def hold(folder: Path) -> None:
    take_folder(folder)
    (folder / "ready").touch()
    time.sleep(60)


def test_two_processes_do_not_write_to_one_folder(tmp_path):
    """The lock ends with its process, however that ends."""
    folder = tmp_path / "run"
    other = fork(hold, folder)
    while not (folder / "ready").exists():
        time.sleep(0.01)
    with pytest.raises(UserError, match=rf"another ns-train is writing there \(process {other.pid}\)"):
        take_folder(folder)
    other.kill()
    assert exit_status(other) == -signal.SIGKILL
    for _ in range(2):
        os.close(take_folder(folder))


@pytest.mark.parametrize("place", ["/proc/run", "/dev/null/run"])
def test_a_place_that_cannot_be_written(place):
    with pytest.raises(UserError, match=r"cannot be written \((.|\n)*--output-dir"):
        take_folder(Path(place))


@pytest.mark.slow
def test_it_is_trained_further_with_other_settings_that_have_no_effect(scan_root, tmp_path):
    train(settings(scan_root, tmp_path, steps=2))
    further = settings(scan_root, tmp_path, steps=1, load_dir=folder_of(tmp_path) / "nerfstudio_models")
    further.pipeline.model.eval_num_rays_per_chunk = 512
    train(further)
    assert last_state(folder_of(tmp_path))["step"] == 2
