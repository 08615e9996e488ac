"""Learning rates and the optimizer, as nerfstudio's configs.

nerfstudio's own schedulers return numpy floats, which are saved in the checkpoint and which torch >= 2.6 refuses to
load; these return Python floats. The whole schedule is saved in the checkpoint, so that a resumed run continues it.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
import tyro
from nerfstudio.engine.optimizers import OptimizerConfig
from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig
from torch.optim.lr_scheduler import LambdaLR

from sl_nerfstudio.field.optimiser import RowAdam


@dataclass
class FusedAdamOptimizerConfig(OptimizerConfig):
    """Adam in one pass over the parameters: six times faster on a large feature table than torch's default."""

    _target: type = torch.optim.Adam

    def setup(self, params: Any) -> torch.optim.Optimizer:
        """The optimiser; on a GPU one whose steps can be recorded as a CUDA graph."""
        optimizer = torch.optim.Adam(params, lr=self.lr, eps=self.eps, fused=True)
        make_recordable([optimizer])
        return optimizer


def make_recordable(optimizers: Iterable[torch.optim.Optimizer]) -> None:
    """Let torch's optimisers of parameters on a GPU be recorded as a CUDA graph, also if a file says otherwise."""
    for group in (group for optimizer in optimizers for group in optimizer.param_groups):
        if "capturable" in group:
            group["capturable"] = all(x.device.type == "cuda" for x in group["params"])


@dataclass
class RowAdamOptimizerConfig(OptimizerConfig):
    """Adam that skips the rows of a feature table that a step did not touch."""

    _target: type = RowAdam
    lr: float = 1e-2
    eps: float = 1e-15


Shape = Literal["cosine", "exponential"]


class LearningRate:
    """Factor on the initial learning rate: a decay to `final`, then constant.

    A callable object rather than a function, so that torch writes its attributes to the checkpoint.
    """

    def __init__(self, shape: Shape, final: float, max_steps: int) -> None:
        self.shape = shape
        self.final = final
        self.max_steps = max_steps

    def __call__(self, step: int) -> float:
        """Factor at a step."""
        progress = min(step / max(self.max_steps, 1), 1.0)
        if self.shape == "cosine":
            return self.final + (1 - self.final) * 0.5 * (1 + math.cos(math.pi * progress))
        return self.final**progress


@dataclass
class DecaySchedulerConfig(SchedulerConfig):
    """Decay of a learning rate."""

    _target: type = field(default_factory=lambda: DecayScheduler)
    shape: tyro.conf.Suppress[Shape] = "cosine"
    """Half a cosine, or exponential decay."""
    final: tyro.conf.Suppress[float] = 0.1
    """Learning rate at the end, as a fraction of the one at the start."""
    max_steps: tyro.conf.Suppress[int | None] = None
    """Step at which the decay ends; by default the length of the run (`--schedule-iterations`)."""


class DecayScheduler(Scheduler):
    """Makes torch's scheduler from a DecaySchedulerConfig."""

    config: DecaySchedulerConfig

    def get_scheduler(self, optimizer: torch.optim.Optimizer, lr_init: float) -> LambdaLR:
        """A scheduler for one optimizer; the initial rate is the optimizer's own.

        Raises ValueError if the length of the run has not been set.
        """
        c = self.config
        if c.max_steps is None:
            raise ValueError("DecaySchedulerConfig.max_steps is not set; SLTrainerConfig sets it before training")
        return LambdaLR(optimizer, LearningRate(c.shape, c.final, c.max_steps))


# The optimisers of each method. Their names are those of nerfstudio's flags: camera_opt is --optimizers.camera-opt.

POSE_GROUPS = ("camera_opt", "projector_opt")


def default_optimizers(method: str) -> dict[str, Any]:
    """Optimisers and decays of the parameters of `sl-neus` or `sl-neus-paper`, by group."""
    if method == "sl-neus-paper":
        rates = {"table": 5e-4, "mlp": 5e-4, **dict.fromkeys(POSE_GROUPS, 1e-3)}
        return {name: _exponential(rate) for name, rate in rates.items()}
    return {
        "table": {"optimizer": RowAdamOptimizerConfig(lr=1e-3), "scheduler": DecaySchedulerConfig(final=0.002)},
        "mlp": _cosine(1e-3, final=0.002),
        **{name: _cosine(1e-4, final=0.01) for name in POSE_GROUPS},
    }


def _cosine(rate: float, final: float) -> dict[str, Any]:
    optimizer = FusedAdamOptimizerConfig(lr=rate, eps=1e-15)
    return {"optimizer": optimizer, "scheduler": DecaySchedulerConfig(final=final)}


def _exponential(rate: float) -> dict[str, Any]:
    """Down to 5e-12 at step 8,000, as in the paper."""
    optimizer = FusedAdamOptimizerConfig(lr=rate, eps=1e-15)
    decay = DecaySchedulerConfig(shape="exponential", final=5e-12 / rate, max_steps=8000)
    return {"optimizer": optimizer, "scheduler": decay}
