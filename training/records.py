"""The output of both trainings: a log, and weights whose metadata say how they were trained."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from safetensors.torch import save_file
from torch import nn


def cosine_rate(highest: float, step: int, steps: int, warm_up: int) -> float:
    """Learning rate of a step: it rises over `warm_up` steps, then falls to zero along a cosine."""
    return highest * min(1.0, (step + 1) / warm_up) * 0.5 * (1 + math.cos(math.pi * step / steps))


def log_row(folder: Path, row: Mapping[str, Any]) -> None:
    """Print a line of figures and add it to `log.jsonl`."""
    line = json.dumps(row)
    print(line, flush=True)
    with (folder / "log.jsonl").open("a") as stream:
        stream.write(line + "\n")


def settings(config: Any) -> dict[str, str]:
    """The settings of a training (a dataclass) as metadata of its weights."""
    return {key: str(value) for key, value in asdict(config).items() if key != "output"}


def save_weights(network: nn.Module, path: Path, config: Any, **more: str) -> None:
    """Write a network as safetensors, with the settings of its training and `more` as its metadata."""
    weights = {key: value.contiguous() for key, value in network.state_dict().items()}
    save_file(weights, path, {**more, **settings(config)})
