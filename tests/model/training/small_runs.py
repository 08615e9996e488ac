"""Short trainings of a tiny scan, called in this process as ns-train would be."""

import copy
import functools
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from nerfstudio.scripts import train as ns_train

from sl_nerfstudio.methods import sl_neus
from sl_nerfstudio.model.run_files import INTERRUPTION
from sl_nerfstudio.model.trainer import SLTrainerConfig

STEPS = 12


def settings(root: Path, output: Path, name: str = "first", steps: int = STEPS, **more: Any) -> SLTrainerConfig:
    """A training that takes a second."""
    config = copy.deepcopy(sl_neus.config)
    assert isinstance(config, SLTrainerConfig)
    config.data, config.output_dir, config.timestamp, config.max_num_iterations = root, output, name, steps
    config.steps_per_eval_batch = 3
    config.pipeline.datamanager.train_num_rays_per_batch = 64
    model = config.pipeline.model
    # One search for the poses is enough.
    model.adjustment = replace(model.adjustment, further_searches=False, other_minima=False)
    sdf = model.sdf
    sdf.log2_table_size, sdf.max_resolution, sdf.hidden = 10, 64, 16
    for key, value in more.items():
        setattr(config, key, value)
    return config


def folder_of(output: Path, name: str = "first") -> Path:
    return output / "sphere" / "sl-neus" / name


def train(config: SLTrainerConfig) -> None:
    ns_train.main(config)


def go_on(config_yml: Path) -> None:
    """`ns-train sl-neus --load-config FILE`."""
    config = copy.deepcopy(sl_neus.config)
    config.load_config = config_yml
    ns_train.main(config)


def edited(folder: Path, change: Callable[[Any], object]) -> Path:
    """The config.yml of a run, after a change of its settings."""
    config = yaml.load((folder / "config.yml").read_text(), Loader=yaml.Loader)
    change(config)
    (folder / "config.yml").write_text(yaml.dump(config))
    return folder / "config.yml"


def last_state(folder: Path) -> dict[str, Any]:
    (checkpoint,) = (folder / "nerfstudio_models").glob("*.ckpt")
    return torch.load(checkpoint)


def require_equal(found: Any, wanted: Any, name: str = "") -> None:
    """All numbers of two checkpoints, bit for bit."""
    if isinstance(wanted, torch.Tensor):
        torch.testing.assert_close(found, wanted, rtol=0, atol=0, equal_nan=True, msg=name)
    elif isinstance(wanted, dict):
        assert found.keys() == wanted.keys(), name
        for key in wanted:
            require_equal(found[key], wanted[key], f"{name}.{key}")
    elif isinstance(wanted, list | tuple):
        assert len(found) == len(wanted), name
        for one, other in zip(found, wanted, strict=True):
            require_equal(one, other, name)
    else:
        assert found == wanted, name


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def send(number: signal.Signals) -> None:
    os.kill(os.getpid(), number)


def sending(number: signal.Signals, function: Callable[..., Any], call: int = 0) -> Callable[..., Any]:
    """The function; at its n-th call the signal comes first."""
    calls = iter(range(10**9))

    @functools.wraps(function)
    def sent(*arguments: Any, **keywords: Any) -> Any:
        if next(calls) == call:
            send(number)
        return function(*arguments, **keywords)

    return sent


@contextmanager
def own_signals() -> Iterator[None]:
    """The signal handlers of pytest come back afterwards."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        INTERRUPTION.remove()
        for number, handler in before.items():
            signal.signal(number, handler)


def status(action: Callable[..., Any], *arguments: Any) -> object:
    """The exit status of what the action ends with."""
    with pytest.raises(SystemExit) as end:
        action(*arguments)
    return end.value.code
