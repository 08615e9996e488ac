"""A training of one of our methods, taken step by step: nerfstudio's trainer and callbacks, without its loop."""

import copy
import time
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from nerfstudio.engine.callbacks import TrainingCallbackLocation

from sl_nerfstudio.dataparser.datamanager import SLDataManagerConfig
from sl_nerfstudio.methods import sl_neus, sl_neus_paper
from sl_nerfstudio.model.loop import SLTrainer
from sl_nerfstudio.model.model import SLModelConfig
from sl_nerfstudio.model.pipeline import SLPipeline
from sl_nerfstudio.model.trainer import SLTrainerConfig

if TYPE_CHECKING:
    from sl_nerfstudio.model.model import SLModel

METHODS = {"sl-neus": sl_neus.config, "sl-neus-paper": sl_neus_paper.config}


def settings(method: str, scan: Path, output: Path, device: str, steps: int) -> SLTrainerConfig:
    """A run of a method, to be changed before it is begun."""
    config = cast(SLTrainerConfig, copy.deepcopy(METHODS[method]))
    config.data, config.output_dir, config.timestamp, config.max_num_iterations = scan, output, "run", steps
    config.pipeline.datamanager.data = scan
    config.machine.device_type = cast(Any, device)
    return config


def model_of(run: SLTrainerConfig) -> SLModelConfig:
    """The settings of its model."""
    return cast(SLModelConfig, run.pipeline.model)


def data_of(run: SLTrainerConfig) -> SLDataManagerConfig:
    """The settings of its pixels."""
    return cast(SLDataManagerConfig, run.pipeline.datamanager)


class Training:
    """A run that was begun; poses stay at their starting values until the losses move them."""

    def __init__(self, config: SLTrainerConfig, adjust: bool = False) -> None:
        """`adjust`: refine the poses first, if the method does."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            config.prepare()
            self.trainer = SLTrainer(config)
            self.trainer.setup()
        samples = self.pipeline.datamanager.samples
        if adjust:
            self.model.adjust_poses(samples)
        self.model.measure_noise(samples)
        self.trainer._saved = (None, time.monotonic())
        self.done = 0

    @property
    def pipeline(self) -> SLPipeline:
        """Data and model."""
        return cast(SLPipeline, self.trainer.pipeline)

    @property
    def model(self) -> "SLModel":
        """The model that is trained."""
        return cast("SLModel", self.pipeline.model)

    def step(self) -> Any:
        """The next step, as nerfstudio's loop does it; returns loss, terms and metrics."""
        self.before()
        return self.iterate()

    def before(self) -> None:
        """What comes before the next step: its number, seeds and annealing."""
        step = self.trainer.step = self.done
        self.pipeline.train()
        for callback in self.trainer.callbacks:
            if TrainingCallbackLocation.BEFORE_TRAIN_ITERATION in callback.where_to_run:
                callback.run_callback(step)

    def iterate(self) -> Any:
        """The step itself."""
        self.done += 1
        return self.trainer.train_iteration(self.done - 1)

    def after(self) -> None:
        """What the loop does after a step: evaluation and a checkpoint if they are due, and the line of progress."""
        self.trainer.eval_iteration(self.done - 1)
