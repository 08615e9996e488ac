"""Trainings by two processes, which nerfstudio starts for two GPUs; here they are forked, and on the CPU."""

import copy
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as dist
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.scripts import train as ns_train
from nerfstudio.utils import comms
from torch import nn

from sl_nerfstudio.model.loop import SharedOptimizers, greatest, share_state
from sl_nerfstudio.model.model import SLModel
from sl_nerfstudio.model.optimisers import RowAdamOptimizerConfig
from sl_nerfstudio.model.run_files import INTERRUPTION
from sl_nerfstudio.model.trainer import SLTrainerConfig
from tests.field.fields import make_field, points_around
from tests.model.training.small_runs import child, folder_of, last_state, require_equal, settings

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]  # nerfstudio warns freely


def in_two(work: Callable[[int], Any], meeting: Path) -> list[int]:
    """Do some work in two processes that know each other; their exit statuses."""

    def joined(rank: int) -> None:
        torch.set_num_threads(1)  # OpenMP's teams do not survive a fork
        INTERRUPTION.remove()  # a process that was not forked has none
        dist.init_process_group("gloo", init_method=f"file://{meeting}", rank=rank, world_size=2)
        comms.LOCAL_PROCESS_GROUP = dist.new_group([0, 1])  # type: ignore[assignment]
        work(rank)
        dist.destroy_process_group()

    processes = [child(lambda rank=rank: joined(rank)) for rank in range(2)]
    return [os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) for process in processes]


def train_by_two(config: SLTrainerConfig) -> list[int]:
    """As nerfstudio does, once it has several devices."""
    config.pipeline.datamanager.data = config.data
    config.set_timestamp()
    config.save_config()
    folder = config.get_base_dir()
    statuses = in_two(lambda rank: ns_train.train_loop(rank, 2, config, rank), folder / ".meeting")
    config.leave_folder()
    (folder / ".meeting").unlink(missing_ok=True)
    return statuses


def test_two_processes_adjust_once_end_together_and_go_on_as_if_nothing_had_happened(scan_root, tmp_path, monkeypatch):
    """A signal reaches the second one in step 3; they agree to stop after step 10."""
    assert train_by_two(settings(scan_root, tmp_path / "whole")) == [0, 0]
    whole, anneal = last_state(folder_of(tmp_path / "whole")), SLModel.anneal

    def interrupted(self: SLModel, step: int) -> None:
        if step == 3 and not comms.is_main_process():
            os.kill(os.getpid(), signal.SIGTERM)
            os.kill(os.getpid(), signal.SIGTERM)  # from a parent that ends its children
        anneal(self, step)

    with monkeypatch.context() as patch:
        patch.setattr(SLModel, "anneal", interrupted)
        assert train_by_two(settings(scan_root, tmp_path / "parts")) == [143, 143]
    folder = folder_of(tmp_path / "parts")
    assert last_state(folder)["step"] == 10
    monkeypatch.setattr("sl_nerfstudio.model.model.adjust_scan", lambda *_: 1 / 0)  # it was adjusted already
    rest = settings(scan_root, tmp_path / "parts", steps=1, load_dir=folder / "nerfstudio_models")
    assert train_by_two(rest) == [0, 0]
    require_equal(last_state(folder), whole)


def test_all_processes_take_the_step_along_the_mean_of_their_gradients(tmp_path):
    """Two shares of some points, against all of them in one process: kernels write the table's gradient themselves."""
    fields = [make_field("numba", seed=seed) for seed in (0, 1)]
    points = points_around(600).float()
    kinds = {"table": RowAdamOptimizerConfig(lr=0.01), "mlp": AdamOptimizerConfig(lr=0.01)}

    def steps(field: nn.Module, make: type, share: slice) -> None:
        groups = {"table": [field.encoding.table], "mlp": list(field.mlp.parameters())}
        optimizers = make({name: {"optimizer": kind, "scheduler": None} for name, kind in kinds.items()}, groups)
        for step in range(3):
            optimizers.zero_grad_some(list(groups))
            p = points[200 * step : 200 * (step + 1)][share]
            (100 * field.sdf(p).square().mean()).backward()
            optimizers.optimizer_scaler_step_some(torch.cuda.amp.grad_scaler.GradScaler(enabled=False), list(groups))

    def work(rank: int) -> None:
        share_state(fields[rank])
        steps(fields[rank], SharedOptimizers, slice(rank, None, 2))
        assert greatest(rank, "cpu") == 1
        torch.save(fields[rank].state_dict(), tmp_path / f"{rank}.pt")

    assert in_two(work, tmp_path / "meeting") == [0, 0]
    found, other = (torch.load(tmp_path / f"{rank}.pt") for rank in (0, 1))
    require_equal(found, other)
    alone = copy.deepcopy(fields[0])
    steps(alone, SharedOptimizers.__base__, slice(None))
    for name, wanted in alone.state_dict().items():
        # Adam divides gradients as small as rounding errors by themselves: single numbers may differ by a step
        assert float((found[name] - wanted).abs().mean()) < 1e-6, name
