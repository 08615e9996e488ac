"""Train the edge network on random captures that the decoder, with the networks of the package, has read.

    python -m training.edges --output outputs/training/edges

writes the captures, the weights as safetensors and a log; an interrupted run continues where it was.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import joblib
import numpy as np
import torch
import tyro
from jaxtyping import Float32
from numpy import ndarray
from safetensors.torch import load_file
from torch import Tensor

from sl_nerfstudio.decoding.grid_edges import EdgeNetwork, EdgeView, slopes
from training.edge_captures import WRONG, EdgeCapture, edge_capture, load_capture, painted_capture, save_capture
from training.edge_errors import continuation_errors, held_out, losses
from training.rendered_captures import rendered_captures
from training.steps import cosine_rate, descend, log_row, made_ahead, resume, save_checkpoint, save_weights

_RISK_WEIGHT = 5.0
_HELD_OUT = 20  # every so many captures one is held out to measure with
_LEAST_KNOWN, _LEAST_WRONG, _OTHERS = 0.15, 0.01, 0.3  # crops with little to learn: share of them that is used
_SLOPE_REACH = 16  # pixels around a crop on which its slopes depend
_WINDOW = 448  # pixels: of larger rectified images the middle is used, so that all fit into memory
_CHECKPOINT = 500  # steps between checkpoints


@dataclass(frozen=True)
class Config:
    """Training of the edge network."""

    output: Path
    """folder of captures, weights, checkpoint and log"""
    captures: int = 900
    """number of painted captures; every twentieth is held out to measure with"""
    size: int = 360
    """width and height of a capture, pixels"""
    objects: int = 72
    """number of random objects that are rendered besides; every twentieth is held out, too"""
    frames: int = 5
    """photographs of each of them"""
    steps: int = 5600
    """number of steps, over which the learning rate falls to zero along a cosine"""
    batch: int = 16
    """crops per step"""
    crop: int = 128
    """width and height of a crop, pixels of the rectified image"""
    rate: float = 2e-3
    """highest learning rate, of AdamW"""
    seed: int = 0
    """determines captures, crops and initial weights"""
    start: Path | None = None
    """weights to start from, as safetensors, instead of random ones"""
    threads: int = 3
    """processor threads of torch, and processes that make captures; one more thread makes crops"""
    log_every: int = 50
    """steps per line of the log"""


# Crops mirrored: a mirrored image of a mirrored pattern is as good an example.

# Places among the channels of `sl_nerfstudio.decoding.grid_edges`.
_SINE_X, _SINE_Y = 9, 11
_MOVE_X, _MOVE_Y = 12, 13
_OF_X, _OF_Y = [8, 9, 12], [10, 11, 13]
_CONTINUED = 15  # the first of eight, counted by angle


class Crop(NamedTuple):
    """Channels of the network, coordinates, slopes (axis of the coordinate, then of the pixel) and true coordinates."""

    channels: Float32[ndarray, "c h w"]
    fitted: Float32[ndarray, "2 h w"]
    slope: Float32[ndarray, "2 2 h w"]
    true: Float32[ndarray, "2 h w"]


def mirrored(
    channels: Float32[ndarray, "c h w"], fitted: Float32[ndarray, "h w 2"], slope: Float32[ndarray, "h w 2 2"],
    true: Float32[ndarray, "h w 2"], how: int,
) -> Crop:  # fmt: skip
    """One of eight: 1 changes left and right, 2 above and below, 4 rows and columns; `how` is their sum."""
    if how & 1:
        channels = _turned_around(channels[:, :, ::-1], _SINE_X, _MOVE_X, 4)
        sign = np.array([-1, 1], dtype=np.float32)
        fitted, true, slope = fitted[:, ::-1] * sign, true[:, ::-1] * sign, slope[:, ::-1] * sign[:, None] * sign
    if how & 2:
        channels = _turned_around(channels[:, ::-1], _SINE_Y, _MOVE_Y, 0)
        sign = np.array([1, -1], dtype=np.float32)
        fitted, true, slope = fitted[::-1] * sign, true[::-1] * sign, slope[::-1] * sign[:, None] * sign
    if how & 4:
        channels = channels.transpose(0, 2, 1).copy()
        channels[_OF_X + _OF_Y] = channels[_OF_Y + _OF_X]
        channels[_CONTINUED:] = channels[_CONTINUED:][[(2 - k) % 8 for k in range(8)]]
        fitted, true = fitted.transpose(1, 0, 2)[..., ::-1], true.transpose(1, 0, 2)[..., ::-1]
        slope = slope.transpose(1, 0, 2, 3)[..., ::-1, ::-1]
    moved = (np.ascontiguousarray(np.moveaxis(part, (0, 1), (-2, -1))) for part in (fitted, slope, true))
    return Crop(channels, *moved)


def _turned_around(channels: Float32[ndarray, "c h w"], sine: int, move: int, first: int) -> Float32[ndarray, "c h w"]:
    """Channels of an image that was mirrored, with the signs and directions that follow from that."""
    out = channels.copy()
    out[[sine, move]] *= -1
    out[_CONTINUED:] = out[_CONTINUED:][[(first - k) % 8 for k in range(8)]]
    return out


def crops(config: Config, captures: Sequence[EdgeCapture], first: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Channels and errors of the batches of steps `first` to the last; each is made while the one before is used."""

    def make(step: int) -> tuple[Tensor, Tensor]:
        rng = np.random.default_rng([config.seed + 1, step])
        made = [_random_crop(rng, captures, config.crop) for _ in range(config.batch)]
        channels, fitted, gradient, true = (torch.from_numpy(np.stack(part)) for part in zip(*made, strict=True))
        with torch.no_grad():
            errors = continuation_errors(fitted, gradient, true)
        return channels.contiguous(memory_format=torch.channels_last), errors

    return made_ahead(make, first, config.steps)


def _random_crop(rng: np.random.Generator, captures: Sequence[EdgeCapture], size: int) -> Crop:
    """A part of a random capture, mirrored at random; rarely one in which everything is right."""
    while True:
        one = captures[rng.integers(len(captures))]
        h, w = one.true.shape[:2]
        i, j = rng.integers(0, h - size + 1), rng.integers(0, w - size + 1)
        part = slice(i, i + size), slice(j, j + size)
        fitted, true = one.view.fitted[part], one.true[part]
        known = np.isfinite(fitted[..., 0])
        if known.mean() <= _LEAST_KNOWN:
            continue
        wrong = known & ~(np.linalg.norm(fitted - true, axis=-1) < WRONG)
        if wrong.mean() > _LEAST_WRONG or rng.random() < _OTHERS:
            slope = _slopes_within(one.view.fitted, i, j, size)
            return mirrored(one.view.part(*part).channels(), fitted, slope, true, int(rng.integers(8)))


def _slopes_within(fitted: Float32[ndarray, "h w 2"], i: int, j: int, size: int) -> Float32[ndarray, "s s 2 2"]:
    """Slopes in a square, as they are in the whole image."""
    top, left = max(0, i - _SLOPE_REACH), max(0, j - _SLOPE_REACH)
    found = slopes(fitted[top : i + size + _SLOPE_REACH, left : j + size + _SLOPE_REACH], 1.0)
    return found[i - top : i - top + size, j - left : j - left + size]


def make_captures(config: Config) -> tuple[list[EdgeCapture], list[EdgeCapture]]:
    """Captures to train with and to measure with; those that an earlier run made are read."""
    folder = config.output / "captures"
    folder.mkdir(parents=True, exist_ok=True)
    jobs = [joblib.delayed(_paint)(config, folder / f"{n:05d}.npz", n) for n in range(config.captures)]
    jobs += [joblib.delayed(_render)(config, folder, n) for n in range(config.objects)]
    joblib.Parallel(config.threads, verbose=5)(jobs)
    numbers = {path: int(path.stem.split("-")[0]) for path in sorted(folder.glob("*.npz"))}
    held = [path for path, number in numbers.items() if number % _HELD_OUT == 0]
    painted, rendered = (
        [_middle(load_capture(path)) for path in numbers if path not in held and ("-" in path.stem) == from_object]
        for from_object in (False, True)
    )
    repeats = max(1, len(painted) // max(1, len(rendered)))  # as many crops of objects as of painted fields
    chosen = [one for one in painted + repeats * rendered if min(one.true.shape[:2]) >= config.crop]
    return chosen, [load_capture(path) for path in held]


def _middle(capture: EdgeCapture) -> EdgeCapture:
    """At most `_WINDOW` pixels a side of a capture."""
    starts = [max(0, side - _WINDOW) // 2 for side in capture.true.shape[:2]]
    rows, columns = (slice(start, start + _WINDOW) for start in starts)
    view = capture.view.part(rows, columns)
    parts = (np.ascontiguousarray(part) for part in (view.measured, view.fitted, view.read, view.continued))
    return EdgeCapture(EdgeView(*parts), capture.true[rows, columns].copy())


def _paint(config: Config, path: Path, number: int) -> None:
    _one_thread()
    if not path.exists() and not path.with_suffix(".none").exists():
        _keep(path, painted_capture(config.seed, number, config.size))


def _render(config: Config, folder: Path, number: int) -> None:
    _one_thread()
    paths = [folder / f"{number:05d}-{frame}.npz" for frame in range(config.frames)]
    if not all(path.exists() or path.with_suffix(".none").exists() for path in paths):
        for path, one in zip(paths, rendered_captures(config.seed, number, config.frames), strict=True):
            _keep(path, edge_capture(one.image, one.grid, one.true))


def _one_thread() -> None:
    cv2.setNumThreads(1)
    torch.set_num_threads(1)


def _keep(path: Path, capture: EdgeCapture | None) -> None:
    if capture is None:
        path.with_suffix(".none").touch()
    else:
        save_capture(path, capture)


def train(config: Config) -> None:
    """Train and write `edges.safetensors`, `log.jsonl` and `checkpoint.pt` into the output folder."""
    captures, held = make_captures(config)
    torch.set_num_threads(config.threads)
    cv2.setNumThreads(1)
    torch.manual_seed(config.seed)
    network = EdgeNetwork()
    if config.start is not None:
        network.load_state_dict(load_file(config.start))
    network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = torch.optim.AdamW(network.parameters(), lr=config.rate, weight_decay=1e-3)
    first = resume(config.output, network, optimizer)
    sums: dict[str, float] = {}
    start = time.monotonic()
    for step, (channels, errors) in zip(range(first, config.steps), crops(config, captures, first), strict=True):
        parts = losses(network(channels), errors)
        rate = cosine_rate(config.rate, step, config.steps, 100)
        descend(network, optimizer, rate, _RISK_WEIGHT * parts["risk"] + parts["wrong"])
        for key, value in parts.items():
            sums[key] = sums.get(key, 0.0) + float(value.detach())
        if (step + 1) % config.log_every == 0:
            row = {key: round(value / config.log_every, 5) for key, value in sums.items()}
            log_row(config.output, {"step": step + 1, "seconds": round(time.monotonic() - start), **row})
            sums.clear()
        if (step + 1) % _CHECKPOINT == 0 or step + 1 == config.steps:
            _save(config, step + 1, network, optimizer)
            row = {key: round(value, 5) for key, value in held_out(network, held).items()}
            log_row(config.output, {"step": step + 1, **row})


def _save(config: Config, step: int, network: EdgeNetwork, optimizer: torch.optim.Optimizer) -> None:
    save_checkpoint(config.output, step, network, optimizer)
    save_weights(network, config.output / "edges.safetensors", config, step=str(step))


if __name__ == "__main__":
    train(tyro.cli(Config, description=__doc__))
