"""Train the U-Net on random captures.

    python -m training.unet --output outputs/training/unet

writes the weights as safetensors and a log; an interrupted run continues from its last checkpoint.
"""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
import tyro
from jaxtyping import Bool, Float, Float32, Int8
from numpy import ndarray
from safetensors.torch import load_file
from torch import Tensor
from torch.nn import functional as F

from sl_nerfstudio.decoding.grid_phases import NetworkOutput, UNet, network_channels
from training.appearance import illuminate, random_difficulty
from training.camera import photograph
from training.patterns import CELLS, PatternStock
from training.steps import cosine_rate, descend, log_row, made_ahead, resume, save_checkpoint, save_weights
from training.surfaces import Surface, random_surface
from training.textures import log_uniform

_NODE_WEIGHT = 3.0  # symbols are read at nodes: errors count more there
_RENEWAL = 20  # steps between two new patterns


@dataclass(frozen=True)
class Config:
    """Training of the U-Net."""

    output: Path
    """folder of weights, checkpoint and log"""
    steps: int = 4000
    """number of steps, over which the learning rate falls to zero along a cosine"""
    batch: int = 8
    """captures per step"""
    size: int = 160
    """width and height of a capture, pixels"""
    rate: float = 3e-3
    """highest learning rate, of AdamW"""
    seed: int = 0
    """determines captures and initial weights"""
    start: Path | None = None
    """weights to start from, as safetensors, instead of random ones"""
    threads: int = 1
    """processor threads of torch; one more generates captures"""
    log_every: int = 50
    """steps per line of the log"""


# Random captures with their truth; about twenty per second.

_SAMPLING = 2


@dataclass(frozen=True)
class Capture:
    """An image of s x s pixels, and the truth at every second place (where four pixels meet)."""

    channels: Float32[ndarray, "2 s s"]
    lit: Bool[ndarray, "h h"]
    certain: Bool[ndarray, "h h"]  # all four pixels show the same surface
    coords: Float32[ndarray, "h h 2"]  # periods
    symbol: Int8[ndarray, "h h"]  # of the nearest node


def random_capture(rng: np.random.Generator, stock: PatternStock, size: int) -> Capture:
    """One random surface under one random pattern in random light."""
    surface, pattern, hard = random_surface(rng, size, _SAMPLING, CELLS), stock.pick(), random_difficulty(rng)
    light = illuminate(rng, surface, pattern, hard)
    view = photograph(rng, light, size, _SAMPLING, hard.blur, hard.noise)
    bright = float(np.quantile(view, 0.995)) * log_uniform(rng, 0.9, 4.0)  # other parts of the image may be brighter
    coords, lit, certain = _at_corners(surface)
    node = np.clip(np.rint(coords), 0, CELLS - 1).astype(np.int64)
    return Capture(network_channels(view, bright), lit, certain, coords, pattern.codes[node[..., 1], node[..., 0]])


def _at_corners(
    surface: Surface,
) -> tuple[Float32[ndarray, "h h 2"], Bool[ndarray, "h h"], Bool[ndarray, "h h"]]:
    """Coordinates and light where four pixels meet: the mean of the four places around."""
    stride, first = 2 * _SAMPLING, _SAMPLING - 1
    parts = [(first + a, first + b) for a in (0, 1) for b in (0, 1)]
    coords = sum(surface.coords[a::stride, b::stride] for a, b in parts) / np.float32(4)
    lit = np.stack([surface.lit[a::stride, b::stride] for a, b in parts])
    layer = np.stack([surface.layer[a::stride, b::stride] for a, b in parts])
    certain = (layer == layer[0]).all(0) & (lit == lit[0]).all(0)
    return np.asarray(coords), lit.mean(0) > 0.5, certain


@dataclass(frozen=True)
class Batch:
    """Captures and their truth as tensors."""

    channels: Float[Tensor, "b 2 s s"]
    lit: Float[Tensor, "b h h"]
    weight: Float[Tensor, "b h h"]  # 1 where lit and certain, else 0
    certain: Float[Tensor, "b h h"]
    phase: Float[Tensor, "b 4 h h"]
    symbol: Tensor  # long, b h h
    node: Float[Tensor, "b h h"]  # 1 within a quarter of a period of a node


def stack(captures: list[Capture]) -> Batch:
    """Captures of one size as a batch."""
    lit = torch.from_numpy(np.stack([c.lit for c in captures]).astype(np.float32))
    certain = torch.from_numpy(np.stack([c.certain for c in captures]).astype(np.float32))
    coords = torch.from_numpy(np.stack([c.coords for c in captures]))
    angle = 2 * math.pi * coords
    phase = torch.stack([angle[..., 0].cos(), angle[..., 0].sin(), angle[..., 1].cos(), angle[..., 1].sin()], 1)
    return Batch(
        torch.from_numpy(np.stack([c.channels for c in captures])).contiguous(memory_format=torch.channels_last), lit,
        lit * certain, certain, phase, torch.from_numpy(np.stack([c.symbol for c in captures]).astype(np.int64)),
        ((coords - coords.round()).abs().amax(-1) < 0.25).float(),
    )  # fmt: skip


def losses(output: NetworkOutput, batch: Batch) -> dict[str, Tensor]:
    """Mask, phase and symbol; the last two only where the pattern is visible on a single surface."""
    total = batch.weight.sum().clamp(min=1.0)
    mask = F.binary_cross_entropy_with_logits(output.mask, batch.lit, reduction="none")
    phase = F.smooth_l1_loss(output.phase, batch.phase, reduction="none", beta=0.2).sum(1)
    near = batch.weight * (1 + _NODE_WEIGHT * batch.node)
    symbol = F.cross_entropy(output.symbol, batch.symbol, reduction="none")
    return {
        "mask": (mask * (0.2 + 0.8 * batch.certain)).mean(),
        "phase": (phase * batch.weight).sum() / total,
        "symbol": (symbol * near).sum() / near.sum().clamp(min=1.0),
    }


def figures(output: NetworkOutput, batch: Batch) -> dict[str, float]:
    """Figures for the log: shares of symbols misread at nodes and of wrong mask pixels, phase errors in periods."""
    with torch.no_grad():
        at_node = (batch.weight * batch.node) > 0
        right = output.symbol.argmax(1) == batch.symbol
        c, s, true_c, true_s = output.phase[:, 0], output.phase[:, 1], batch.phase[:, 0], batch.phase[:, 1]
        error = torch.atan2(s * true_c - c * true_s, c * true_c + s * true_s).abs() / (2 * math.pi)
        where = batch.weight > 0
        return {
            "misread": 1 - float(right[at_node].float().mean()),
            "phase_median": float(error[where].median()),
            "phase_90": float(error[where].quantile(0.9)),
            "mask_wrong": float(((output.mask > 0) != (batch.lit > 0.5)).float().mean()),
        }


def batches(config: Config, first: int) -> Iterator[Batch]:
    """The batches of steps `first` to the last; each is generated while the one before is used."""
    stock = PatternStock(np.random.default_rng([config.seed, 1, first]), 24)

    def make(step: int) -> Batch:
        rng = np.random.default_rng([config.seed, 0, step])
        if step % _RENEWAL == 0:
            stock.renew()
        return stack([random_capture(rng, stock, config.size) for _ in range(config.batch)])

    return made_ahead(make, first, config.steps)


def train(config: Config) -> None:
    """Train and write `unet.safetensors`, `log.jsonl` and `checkpoint.pt` into the output folder."""
    torch.set_num_threads(config.threads)
    cv2.setNumThreads(1)
    config.output.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(config.seed)
    network = UNet().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    if config.start is not None:
        network.load_state_dict(load_file(config.start))
    optimizer = torch.optim.AdamW(network.parameters(), lr=config.rate, weight_decay=1e-3)
    first = resume(config.output, network, optimizer)
    sums: dict[str, float] = {}
    start = time.monotonic()
    for step, batch in zip(range(first, config.steps), batches(config, first), strict=True):
        output = network(batch.channels)
        parts = losses(output, batch)
        rate = cosine_rate(config.rate, step, config.steps, 100)
        descend(network, optimizer, rate, sum(parts.values(), torch.zeros(())))
        for key, value in {**{k: float(v.detach()) for k, v in parts.items()}, **figures(output, batch)}.items():
            sums[key] = sums.get(key, 0.0) + value
        if (step + 1) % config.log_every == 0:
            row = {key: round(value / config.log_every, 5) for key, value in sums.items()}
            log_row(config.output, {"step": step + 1, "seconds": round(time.monotonic() - start), **row})
            sums.clear()
        if (step + 1) % (2 * config.log_every) == 0 or step + 1 == config.steps:
            _save(config, step + 1, network, optimizer)


def _save(config: Config, step: int, network: UNet, optimizer: torch.optim.Optimizer) -> None:
    save_checkpoint(config.output, step, network, optimizer)
    save_weights(network, config.output / "unet.safetensors", config, step=str(step))


if __name__ == "__main__":
    train(tyro.cli(Config, description=__doc__))
