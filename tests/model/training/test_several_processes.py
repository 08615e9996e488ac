"""Trainings by two processes, which nerfstudio starts for two GPUs; here they work on the CPU."""

import os
import signal
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as dist
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.scripts import train as ns_train
from nerfstudio.utils import comms

from sl_nerfstudio.field.field import SDFField
from sl_nerfstudio.model import model
from sl_nerfstudio.model.loop import SharedOptimizers, greatest, share_state
from sl_nerfstudio.model.model import SLModel
from sl_nerfstudio.model.optimisers import RowAdamOptimizerConfig
from sl_nerfstudio.model.trainer import SLTrainerConfig
from tests.field.fields import make_field, points_around
from tests.forks import LONGEST, exit_status, fork
from tests.model.training.small_runs import folder_of, last_state, require_equal, settings

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]  # nerfstudio warns freely


def joined(work: Callable[..., None], rank: int, meeting: Path, *arguments: Any) -> None:
    """The work of one of two processes that know each other."""
    dist.init_process_group("gloo", f"file://{meeting}", timedelta(seconds=LONGEST), world_size=2, rank=rank)
    comms.LOCAL_PROCESS_GROUP = dist.new_group([0, 1])  # type: ignore[assignment]
    work(rank, *arguments)
    dist.destroy_process_group()


def in_two(work: Callable[..., None], meeting: Path, *arguments: Any) -> list[int]:
    """Do some work in two processes that know each other; their exit statuses."""
    both = [fork(joined, work, rank, meeting, *arguments) for rank in range(2)]
    return [exit_status(process) for process in both]


def train_by_two(config: SLTrainerConfig, work: Callable[..., None]) -> list[int]:
    """As nerfstudio does, once it has several devices."""
    config.pipeline.datamanager.data = config.data
    config.set_timestamp()
    config.save_config()
    folder = config.get_base_dir()
    statuses = in_two(work, folder / ".meeting", config)
    config.leave_folder()
    (folder / ".meeting").unlink(missing_ok=True)
    return statuses


def whole(rank: int, config: SLTrainerConfig) -> None:
    ns_train.train_loop(rank, 2, config, rank)


def interrupted(rank: int, config: SLTrainerConfig) -> None:
    """A signal reaches the second process in step 3."""
    anneal = SLModel.anneal

    def annealed(self: SLModel, step: int) -> None:
        if step == 3 and rank == 1:
            os.kill(os.getpid(), signal.SIGTERM)
            os.kill(os.getpid(), signal.SIGTERM)  # from a parent that ends its children
        anneal(self, step)

    SLModel.anneal = annealed  # type: ignore[method-assign]
    whole(rank, config)


def adjusted_already(rank: int, config: SLTrainerConfig) -> None:
    model.adjust_scan = lambda *_: 1 / 0  # type: ignore[assignment]
    whole(rank, config)


def test_two_processes_adjust_once_end_together_and_go_on_as_if_nothing_had_happened(scan_root, tmp_path):
    """Once one of them is told to stop, they agree to do so after step 10."""
    assert train_by_two(settings(scan_root, tmp_path / "whole"), whole) == [0, 0]
    assert train_by_two(settings(scan_root, tmp_path / "parts"), interrupted) == [143, 143]
    folder = folder_of(tmp_path / "parts")
    assert last_state(folder)["step"] == 10
    rest = settings(scan_root, tmp_path / "parts", steps=1, load_dir=folder / "nerfstudio_models")
    assert train_by_two(rest, adjusted_already) == [0, 0]
    require_equal(last_state(folder), last_state(folder_of(tmp_path / "whole")))


def fields() -> list[SDFField]:
    """Two that differ."""
    return [make_field("numba", seed=seed) for seed in (0, 1)]


def steps(field: SDFField, make: type, share: slice) -> None:
    """Three steps on a share of some points."""
    kinds = {"table": RowAdamOptimizerConfig(lr=0.01), "mlp": AdamOptimizerConfig(lr=0.01)}
    groups = {"table": [field.encoding.table], "mlp": list(field.mlp.parameters())}
    optimizers = make({name: {"optimizer": kind, "scheduler": None} for name, kind in kinds.items()}, groups)
    points = points_around(600).float()
    for step in range(3):
        optimizers.zero_grad_some(list(groups))
        p = points[200 * step : 200 * (step + 1)][share]
        (100 * field.sdf(p).square().mean()).backward()
        optimizers.optimizer_scaler_step_some(torch.cuda.amp.grad_scaler.GradScaler(enabled=False), list(groups))


def shared_steps(rank: int, folder: Path) -> None:
    field = fields()[rank]
    share_state(field)
    steps(field, SharedOptimizers, slice(rank, None, 2))
    assert greatest(rank, "cpu") == 1
    torch.save(field.state_dict(), folder / f"{rank}.pt")


def test_all_processes_take_the_step_along_the_mean_of_their_gradients(tmp_path):
    """Two shares of some points, against all of them in one process: kernels write the table's gradient themselves."""
    assert in_two(shared_steps, tmp_path / "meeting", tmp_path) == [0, 0]
    found, other = (torch.load(tmp_path / f"{rank}.pt") for rank in (0, 1))
    require_equal(found, other)
    alone = fields()[0]
    steps(alone, SharedOptimizers.__base__, slice(None))
    for name, wanted in alone.state_dict().items():
        # Adam divides gradients as small as rounding errors by themselves: single numbers may differ by a step
        assert float((found[name] - wanted).abs().mean()) < 1e-6, name
