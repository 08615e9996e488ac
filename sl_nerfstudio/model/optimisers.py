"""Learning rates and the optimizer, as nerfstudio's configs.

nerfstudio's own schedulers return numpy floats, which are saved in the checkpoint and which torch >= 2.6 refuses to
load; these return Python floats. The whole schedule is saved in the checkpoint, so that a resumed run continues it.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from nerfstudio.engine.optimizers import OptimizerConfig
from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig
from torch.optim.lr_scheduler import LambdaLR

from sl_nerfstudio.field.optimiser import RowAdam


@dataclass
class FusedAdamOptimizerConfig(OptimizerConfig):
    """Adam in one pass over the parameters: six times faster on a large feature table than torch's default."""

    _target: type = torch.optim.Adam
    betas: tuple[float, float] = (0.9, 0.999)
    """Decay rates of the running mean of the gradient and of its square."""
    weight_decay: float = 0.0
    """L2 penalty."""
    fused: bool = True
    """Use torch's fused kernel."""

    def setup(self, params: Any) -> torch.optim.Optimizer:
        """The optimiser; on a GPU one whose steps can be recorded as a CUDA graph."""
        settings = {name: value for name, value in vars(self).items() if name not in ("_target", "max_norm")}
        optimizer = self._target(params, **settings)
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
    betas: tuple[float, float] = (0.9, 0.99)
    """Decay rates of the running mean of the gradient and of its square."""


Shape = Literal["cosine", "exponential"]


class LearningRate:
    """Factor on the initial learning rate: a linear warm-up, then a decay to `final`, then constant.

    A callable object rather than a function, so that torch writes its attributes to the checkpoint.
    """

    def __init__(self, shape: Shape, final: float, warm_up: int, max_steps: int) -> None:
        self.shape = shape
        self.final = final
        self.warm_up = warm_up
        self.max_steps = max_steps

    def __call__(self, step: int) -> float:
        """Factor at a step."""
        if step < self.warm_up:
            return (step + 1) / (self.warm_up + 1)
        progress = min((step - self.warm_up) / max(self.max_steps - self.warm_up, 1), 1.0)
        if self.shape == "cosine":
            return self.final + (1 - self.final) * 0.5 * (1 + math.cos(math.pi * progress))
        return self.final**progress


@dataclass
class DecaySchedulerConfig(SchedulerConfig):
    """Warm-up and decay of a learning rate."""

    _target: type = field(default_factory=lambda: DecayScheduler)
    shape: Shape = "cosine"
    """Half a cosine, or exponential decay."""
    final: float = 0.1
    """Learning rate at the end, as a fraction of the one at the start."""
    warm_up: int = 0
    """Steps of linear warm-up."""
    max_steps: int | None = None
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
        return LambdaLR(optimizer, LearningRate(c.shape, c.final, c.warm_up, c.max_steps))
