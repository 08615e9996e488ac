"""Trainings by two processes on the CPU. They are forked here, which spares them nerfstudio's imports."""

import functools
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from nerfstudio.scripts import train as ns_train
from nerfstudio.utils import comms
from torch import nn

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.field.backend import TableGradient
from sl_nerfstudio.field.optimiser import RowAdam
from sl_nerfstudio.model import processes
from sl_nerfstudio.model.model import SLModel
from sl_nerfstudio.model.processes import MeanGradients, greatest, share_state
from sl_nerfstudio.model.trainer import SLTrainerConfig
from sl_nerfstudio.runs.run import load_run
from tests.model.training.small_runs import folder_of, go_on, last_state, require_equal, settings, status, train

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]  # nerfstudio warns freely

ROWS = 3000  # each process averages some of them
forked = functools.partial(mp.start_processes, start_method="fork")


@pytest.fixture(autouse=True)
def _two_cores_and_forks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ns_train, "launch", ns_train.launch)  # what takes its place would start all later trainings
    monkeypatch.setattr(processes.mp, "spawn", forked)
    monkeypatch.setattr("sl_nerfstudio.model.trainer.cores", lambda: 2)
    monkeypatch.setattr(processes, "cores", lambda: 2)  # one thread each: OpenMP teams do not survive a fork


def by_two(root: Path, output: Path, **more: Any) -> SLTrainerConfig:
    config = settings(root, output, **more)
    config.machine.num_devices, config.machine.device_type = 2, "cpu"
    return config


def only_main(action: Callable[[], Any]) -> None:
    if comms.is_main_process():
        action()


def test_two_processes_adjust_once_end_together_and_go_on_as_if_nothing_had_happened(
    scan_root, tmp_path, monkeypatch, capfd
):
    """SIGINT reaches the process that started the two, in step 3; they agree to stop after step 10."""
    train(by_two(scan_root, tmp_path / "whole"))
    whole = capfd.readouterr()
    assert whole.out.count("adjust ") == whole.out.count("next:") == 1, whole.out
    assert "Traceback" not in whole.err

    calls = iter(range(10**9))
    anneal, parent = SLModel.anneal, os.getpid()

    def interrupts(self: SLModel, step: int) -> None:
        if next(calls) == 3:
            only_main(lambda: os.kill(parent, signal.SIGINT))
        anneal(self, step)

    with monkeypatch.context() as patch:
        patch.setattr(SLModel, "anneal", interrupts)
        assert status(train, by_two(scan_root, tmp_path / "parts")) == 130
    folder = folder_of(tmp_path / "parts")
    said = capfd.readouterr()
    assert said.err.count("to go on:") == 1 and "Traceback" not in said.out + said.err
    assert last_state(folder)["step"] == 10
    monkeypatch.setattr("sl_nerfstudio.model.model.adjust_scan", lambda *_: pytest.fail("adjusted again"))
    go_on(folder / "config.yml")
    require_equal(last_state(folder), last_state(folder_of(tmp_path / "whole")))
    assert load_run(folder).model.history()["step"][0] == 0


def test_a_fault_in_one_process_is_one_message(scan_root, tmp_path, monkeypatch, capfd):
    def fails(*_: object) -> None:
        raise UserError("the frames do not agree")

    monkeypatch.setattr("sl_nerfstudio.model.model.adjust_scan", fails)
    assert status(train, by_two(scan_root, tmp_path)) == 1
    error = capfd.readouterr().err
    assert error.count("error: the frames do not agree") == 1 and "Traceback" not in error


def test_more_processes_than_cores_are_refused(scan_root, tmp_path, capfd):
    config = by_two(scan_root, tmp_path)
    config.machine.num_devices = 3
    assert status(train, config) == 1
    assert "--machine.num-devices 3: this machine has 2 cores" in capfd.readouterr().err


def _in_two(work: Callable[[int, Path], None], folder: Path) -> None:
    forked(_joined, (work, folder), nprocs=2)


def _joined(rank: int, work: Callable[[int, Path], None], folder: Path) -> None:
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/meeting", rank=rank, world_size=2)
    work(rank, folder)
    dist.destroy_process_group()


def gradients(rank: int, step: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Of a table, in some of its rows, and of a matrix."""
    random = torch.Generator().manual_seed(10 * step + rank)
    rows = torch.randperm(ROWS, generator=random)[: ROWS // 3]
    table = torch.zeros(ROWS, 8)
    table[rows] = torch.randn(len(rows), 8, generator=random)
    return table, torch.randn(3, 5, generator=random)


def _three_steps(rank: int, folder: Path) -> None:
    torch.manual_seed(rank)
    model = nn.ParameterList([nn.Parameter(torch.randn(ROWS, 8)), nn.Parameter(torch.randn(3, 5))])
    share_state(model)
    table, matrix = model
    average_gradients = MeanGradients()
    optimisers = RowAdam([table], lr=0.1), torch.optim.SGD([matrix], lr=0.1)
    for step in range(3):
        buffer = TableGradient.of(table)
        own, matrix.grad = gradients(rank, step)
        buffer.attach(table)
        buffer.buffer.numpy()[...] = own.numpy()  # as a kernel does: torch does not notice
        buffer.marks[:ROWS] = own.any(1)
        average_gradients(model)
        for optimiser in optimisers:
            optimiser.step()
            optimiser.zero_grad()
    assert greatest(rank, "cpu") == 1
    buffer = TableGradient.of(table)
    buffer.attach(table)
    buffer.marks = torch.zeros(0, dtype=torch.uint8)  # as on a GPU
    buffer.buffer.copy_(gradients(rank, 9)[0])
    average_gradients([table])
    torch.testing.assert_close(buffer.buffer, (gradients(0, 9)[0] + gradients(1, 9)[0]) / 2)
    torch.save([table.detach(), matrix.detach()], folder / f"{rank}.pt")


@pytest.mark.parametrize("shared", [True, False], ids=["shared memory", "messages"])
def test_all_processes_take_the_step_along_the_mean_of_their_gradients(tmp_path, monkeypatch, shared):
    """Against torch's own Adam with the mean gradient, in rows that every step touches, and against none elsewhere."""
    if not shared:  # as on several machines
        monkeypatch.setattr(processes, "_opened", lambda *_: None)
    _in_two(_three_steps, tmp_path)
    (table, matrix), other = (torch.load(tmp_path / f"{rank}.pt") for rank in (0, 1))
    require_equal([table, matrix], other)
    torch.manual_seed(0)
    start, start_matrix = torch.randn(ROWS, 8), torch.randn(3, 5)
    means = [[(a + b) / 2 for a, b in zip(gradients(0, k), gradients(1, k), strict=True)] for k in range(3)]
    torch.testing.assert_close(matrix, start_matrix - 0.1 * sum(mean for _, mean in means))
    touched = torch.stack([mean.any(1) for mean, _ in means]).sum(0)
    assert (touched == 0).sum() > 0 and (touched == 3).sum() > 0
    require_equal(table[touched == 0], start[touched == 0])
    every = nn.Parameter(start[touched == 3].clone())
    adam = torch.optim.Adam([every], lr=0.1, betas=(0.9, 0.99), eps=1e-15)
    for mean, _ in means:
        every.grad = mean[touched == 3]
        adam.step()
    torch.testing.assert_close(table[touched == 3], every.detach())
