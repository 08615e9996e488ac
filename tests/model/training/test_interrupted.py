"""Trainings that are stopped by a signal, or killed, at any moment."""

import copy
import itertools
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from nerfstudio.engine.trainer import Trainer

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.model.model import SLModel
from sl_nerfstudio.model.run_files import Interrupted, Interruption, checkpoints_in
from sl_nerfstudio.model.trainer import SLTrainerConfig
from sl_nerfstudio.runs.run import load_run
from tests.forks import exit_status, fork
from tests.model.training.small_runs import (
    folder_of,
    go_on,
    last_state,
    require_equal,
    send,
    sending,
    settings,
    status,
    train,
)

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]  # nerfstudio warns freely

SIGNALS = {signal.SIGINT: 130, signal.SIGTERM: 143}
SAID = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}


@pytest.mark.parametrize("number, step", [(signal.SIGTERM, 3), (signal.SIGINT, 7)])
def test_a_signal_saves_the_step_and_the_run_goes_on_as_if_nothing_had_happened(
    scan_root, finished, tmp_path, monkeypatch, capfd, number, step
):
    """Steps 3 and 7 are evaluated or not, and lie in and after the warm start."""
    with monkeypatch.context() as patch:
        patch.setattr(SLModel, "anneal", sending(number, SLModel.anneal, step))
        assert status(train, settings(scan_root, tmp_path)) == SIGNALS[number]
    folder = folder_of(tmp_path)
    said = capfd.readouterr()
    assert "Traceback" not in said.out + said.err
    line = f"to go on: ns-train sl-neus --load-config {folder}/config.yml"
    assert said.err.splitlines()[-2:] == [SAID[number], line]
    assert [path.name for path in checkpoints_in(folder / "nerfstudio_models")] == [f"step-{step:09d}.ckpt"]
    monkeypatch.setattr("sl_nerfstudio.model.model.adjust_scan", lambda *_: pytest.fail("adjusted again"))
    go_on(folder / "config.yml")
    require_equal(last_state(folder), last_state(finished))


def test_poses_are_saved_as_soon_as_they_are_adjusted(scan_root, finished, tmp_path, monkeypatch, capfd):
    with monkeypatch.context() as patch:
        patch.setattr(SLModel, "measure_noise", sending(signal.SIGINT, SLModel.measure_noise))
        assert status(train, settings(scan_root, tmp_path)) == 130
    folder = folder_of(tmp_path)
    state = last_state(folder)
    assert state["step"] == -1
    assert state["pipeline"]["_model.device_poses.sigma"].isfinite().all()  # NaN before the adjustment
    with pytest.raises(
        UserError, match=r"holds adjusted poses, but no surface yet(.|\n)*ns-train sl-neus --load-config"
    ):
        load_run(folder)
    monkeypatch.setattr("sl_nerfstudio.model.model.adjust_scan", lambda *_: pytest.fail("adjusted again"))
    go_on(folder / "config.yml")
    require_equal(last_state(folder), last_state(finished))


def test_a_signal_during_the_adjustment_ends_it_at_once(scan_root, finished, tmp_path, monkeypatch, capfd):
    with monkeypatch.context() as patch:
        patch.setattr("sl_nerfstudio.model.model.adjust_scan", lambda *_: send(signal.SIGTERM) or time.sleep(60))
        assert status(train, settings(scan_root, tmp_path)) == 143
    folder = folder_of(tmp_path)
    assert f"to go on: ns-train sl-neus --load-config {folder}/config.yml" in capfd.readouterr().err
    go_on(folder / "config.yml")
    require_equal(last_state(folder), last_state(finished))


def test_a_signal_during_the_checks_leaves_nothing(scan_root, tmp_path, monkeypatch, capfd):
    monkeypatch.setattr("sl_nerfstudio.model.trainer.require_valid", lambda _: send(signal.SIGINT))
    assert status(train, settings(scan_root, tmp_path / "new")) == 130
    assert capfd.readouterr().err.strip() == "interrupted"
    assert not (tmp_path / "new").exists()


def test_a_signal_while_a_checkpoint_is_written_waits_for_its_end(scan_root, tmp_path, monkeypatch):
    monkeypatch.setattr(torch, "save", sending(signal.SIGTERM, torch.save, 1))
    assert status(train, settings(scan_root, tmp_path, steps_per_save=5)) == 143
    assert last_state(folder_of(tmp_path))["step"] == 5
    assert not [path for path in folder_of(tmp_path).rglob("*.partial")]


def test_a_full_disk_is_a_message_and_keeps_what_is_there(scan_root, tmp_path, monkeypatch, capfd):
    def fails(state: dict, path: Path) -> None:
        path.write_bytes(b"half of it")
        raise OSError(28, "No space left on device")

    real = torch.save
    monkeypatch.setattr(torch, "save", lambda state, path: (real if state["step"] < 5 else fails)(state, path))
    assert status(train, settings(scan_root, tmp_path, steps_per_save=5)) == 1
    error = capfd.readouterr().err
    assert "cannot be written" in error and "No space left" in error and "Traceback" not in error
    assert last_state(folder_of(tmp_path))["step"] == -1
    assert not [path for path in folder_of(tmp_path).rglob("*.partial")]


def test_checkpoints_are_written_when_time_and_steps_have_passed(scan_root, tmp_path, monkeypatch):
    saved = []
    monkeypatch.setattr("sl_nerfstudio.model.loop.LEAST_STEPS", 4)
    monkeypatch.setattr(torch, "save", lambda state, path: saved.append(state["step"]) or path.touch())
    monkeypatch.setattr("sl_nerfstudio.model.loop.SECONDS_PER_SAVE", 0.0)
    train(settings(scan_root, tmp_path, "often"))
    assert saved == [-1, 3, 7, 11, 11]  # the last one by nerfstudio, at the end
    saved.clear()
    monkeypatch.setattr("sl_nerfstudio.model.loop.SECONDS_PER_SAVE", 1000.0)
    train(settings(scan_root, tmp_path, "seldom"))
    assert saved == [-1, 11]


def test_a_signal_ends_a_training_that_is_paused_in_the_viewer(scan_root, tmp_path, monkeypatch, capfd):
    """It comes while nerfstudio waits for the button; not one step was trained."""
    waits = SimpleNamespace(**{**vars(time), "sleep": sending(signal.SIGTERM, time.sleep)})
    monkeypatch.setattr("nerfstudio.engine.trainer.time", waits)
    monkeypatch.setattr(SLModel, "anneal", lambda self, step: pytest.fail(f"step {step} was trained"))
    assert status(train, settings(scan_root, tmp_path, start_paused=True)) == 143
    folder = folder_of(tmp_path)
    assert capfd.readouterr().err.splitlines()[-1] == f"to go on: ns-train sl-neus --load-config {folder}/config.yml"
    assert last_state(folder)["step"] == -1


def test_control_c_in_the_viewer_of_a_finished_training_is_its_normal_end(scan_root, tmp_path, monkeypatch):
    monkeypatch.setattr(Trainer, "_train_complete_viewer", lambda _: send(signal.SIGINT))
    train(settings(scan_root, tmp_path, steps=1))
    assert last_state(folder_of(tmp_path))["step"] == 0


def signalled_twice(first: signal.Signals, second: signal.Signals) -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)
    interruption = Interruption()
    interruption.install()
    interruption.hold()
    send(first)
    send(second)
    os._exit(99)  # never reached


@pytest.mark.parametrize("first, second", [(signal.SIGINT, signal.SIGINT), (signal.SIGINT, signal.SIGTERM)])
def test_a_second_signal_ends_the_process_at_once(first, second):
    assert exit_status(fork(signalled_twice, first, second)) == SIGNALS[second]


def test_an_ignored_signal_stays_ignored():
    """As for a job that a script starts in the background."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    interruption = Interruption()
    interruption.install()
    try:
        send(signal.SIGINT)
        with pytest.raises(Interrupted):
            send(signal.SIGTERM)
    finally:
        interruption.remove()
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_two_trainings_are_equal_whatever_else_the_machine_does(scan_root, tmp_path):
    """Bit for bit, with several threads and other processes that take the processor away."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    busy: list[ForkServerProcess] = []
    try:
        train(settings(scan_root, tmp_path, "alone", steps=6))
        busy = [fork(sum, itertools.repeat(0)) for _ in range(os.cpu_count() or 1)]
        train(settings(scan_root, tmp_path, "beside others", steps=6))
    finally:
        torch.set_num_threads(before)
        for process in busy:
            process.kill()
    require_equal(last_state(folder_of(tmp_path, "beside others")), last_state(folder_of(tmp_path, "alone")))


def test_a_killed_training_goes_on_or_starts_again(scan_root, finished, tmp_path):
    """SIGKILL at seeded moments, one after the other, until the training is through: the result is the same."""
    folder, moments = folder_of(tmp_path), random.Random(7)
    config = settings(scan_root, tmp_path, steps_per_save=2)
    for _ in range(6):
        process = fork(go_on_or_train(folder, config))
        process.join(moments.uniform(0.3, 2.0))
        if process.exitcode == 0:
            break
        process.kill()
        assert exit_status(process) == -signal.SIGKILL
    else:
        go_on_or_train(folder, config)()
    require_equal(torch.load(checkpoints_in(folder / "nerfstudio_models")[-1]), last_state(finished))
    assert not list(folder.rglob("*.partial"))


def go_on_or_train(folder: Path, config: SLTrainerConfig) -> Callable[[], None]:
    """What a person would do next: killed during the checks, nothing is there."""
    if (folder / "config.yml").exists():
        return partial(go_on, folder / "config.yml")
    return partial(train, copy.deepcopy(config))


def test_the_installed_command_itself(scan_root, tmp_path):
    """A real process, stopped as a scheduler would stop it."""
    flags = ["--data", scan_root, "--output-dir", "out", "--timestamp", "first", "--max-num-iterations", 100000]
    process = subprocess.Popen(
        [Path(sys.executable).with_name("ns-train"), "sl-neus", *map(str, flags)],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    folder = folder_of(tmp_path / "out")
    while not checkpoints_in(folder / "nerfstudio_models") and process.poll() is None:
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 143 and "Traceback" not in out + err
    assert err.splitlines()[-1] == f"to go on: ns-train sl-neus --load-config {folder}/config.yml"
    assert last_state(folder)["pipeline"]["_model.device_poses.sigma"].isfinite().all()  # NaN before the adjustment
