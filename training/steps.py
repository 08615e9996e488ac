"""What the trainings share: batches made ahead, a step of the optimiser, checkpoints, logs and weights."""

import json
import math
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors.torch import save_file
from torch import Tensor, nn


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


_LARGEST_GRADIENT = 2.0

B = TypeVar("B")


def made_ahead(make: Callable[[int], B], first: int, steps: int) -> Iterator[B]:
    """The batches of steps `first` to the last; each is made while the one before is used."""
    with ThreadPoolExecutor(1) as maker:
        coming = maker.submit(make, first)
        for step in range(first, steps):
            batch = coming.result()
            if step + 1 < steps:
                coming = maker.submit(make, step + 1)
            yield batch


def descend(network: nn.Module, optimizer: torch.optim.Optimizer, rate: float, loss: Tensor) -> None:
    """One step of the optimiser with a learning rate; large gradients are cut."""
    for group in optimizer.param_groups:
        group["lr"] = rate
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    torch.nn.utils.clip_grad_norm_(network.parameters(), _LARGEST_GRADIENT)
    optimizer.step()


def save_checkpoint(folder: Path, step: int, network: nn.Module, optimizer: torch.optim.Optimizer) -> None:
    """Write `checkpoint.pt` into a folder, whole or not at all."""
    state = {"step": step, "network": network.state_dict(), "optimizer": optimizer.state_dict()}
    torch.save(state, folder / "checkpoint.new")
    (folder / "checkpoint.new").replace(folder / "checkpoint.pt")


def resume(folder: Path, network: nn.Module, optimizer: torch.optim.Optimizer) -> int:
    """The first step: 0, or that of the checkpoint in the folder, whose state is taken over."""
    path = folder / "checkpoint.pt"
    if not path.exists():
        return 0
    state = torch.load(path, weights_only=True)
    network.load_state_dict(state["network"])
    optimizer.load_state_dict(state["optimizer"])
    return int(state["step"])
