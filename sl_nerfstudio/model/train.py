"""`ns-train` as a part of another command or program."""

from copy import deepcopy
from pathlib import Path
from typing import Any

from nerfstudio.configs.method_configs import all_methods
from nerfstudio.scripts import train

from sl_nerfstudio.model.run_files import Watch, part_of, quiet_nerfstudio


def settings_of_run(method: str, scan: Path, output: Path, experiment: str, name: str, steps: int | None) -> Any:
    """The settings of a new run in `output`/`experiment`/`method`/`name`; steps: None for as many as is usual."""
    config: Any = deepcopy(all_methods[method])
    config.data, config.output_dir, config.experiment_name, config.timestamp = scan, output, experiment, name
    config.max_num_iterations = config.max_num_iterations if steps is None else steps
    return config


def train_within(command: str, config: Any, watch: Watch | None = None) -> None:
    """Train a new run, or one that was stopped.

    `command` is what goes on with it; `watch` gets the model after each step.
    Raises SystemExit with a message for what a user can correct, and if it is interrupted.
    """
    quiet_nerfstudio(True)
    with part_of(command, watch):
        train.main(config)
