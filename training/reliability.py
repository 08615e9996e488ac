"""Train the model of wrong pixels on random captures that the decoder, with the networks of the package, has decoded.

python -m training.reliability --output outputs/training/reliability
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
import tyro
from jaxtyping import Bool, Float32
from numpy import ndarray
from safetensors.torch import save_file

from sl_nerfstudio.decoding.decoded import DecodingError
from sl_nerfstudio.decoding.grid.image_decoder import GridImageDecoder
from training.appearance import illuminate, random_difficulty
from training.camera import photograph
from training.patterns import CELLS, draw_pattern, random_grid
from training.records import log_row, settings
from training.surfaces import Surface, random_surface

_WRONG = 0.1  # periods
_SAMPLING = 2
_ONLY_WRONG = 0.5  # share: a capture that shows more is one that nobody could read, and is left out


@dataclass(frozen=True)
class Config:
    """Training of the model of wrong pixels."""

    output: Path
    """folder of the weights and the log"""
    captures: int = 120
    """number of captures; every second one is held out to measure with"""
    size: int = 360
    """width and height of a capture, pixels"""
    pixels: int = 20000
    """pixels of each capture that are used"""
    seed: int = 0
    """determines the captures"""
    threads: int = 1
    """processor threads"""


def examples(config: Config, number: int) -> tuple[Float32[ndarray, "n 5"], Bool[ndarray, "n"]] | None:
    """Features of decoded pixels of one capture, and whether each is wrong; None if it cannot be decoded."""
    rng = np.random.default_rng([config.seed, 2, number])
    grid = random_grid(rng)
    surface, hard = random_surface(rng, config.size, _SAMPLING, CELLS), random_difficulty(rng)
    light = illuminate(rng, surface, draw_pattern(grid), hard)
    image = photograph(rng, light, config.size, _SAMPLING, hard.blur, hard.noise)
    decoder = GridImageDecoder(grid)
    try:
        found = decoder.detect(image)
    except DecodingError:
        return None
    evidence = decoder.examine(image, found)
    error = np.linalg.norm(evidence.fitted / grid.period - 0.5 - _at_pixels(surface), axis=-1)
    row, column = np.nonzero(np.isfinite(evidence.fitted[..., 0]))
    wrong = ~(error[row, column] < _WRONG)
    if len(row) == 0 or wrong.mean() > _ONLY_WRONG:
        return None
    chosen = rng.permutation(len(row))[: config.pixels]
    features = evidence.features(grid.period, found.appearance.period)[row, column]
    return features[chosen], wrong[chosen]


def _at_pixels(surface: Surface) -> Float32[ndarray, "s s 2"]:
    """Coordinates in periods of the pixels' centres; NaN where the pattern is not, and at borders."""
    parts = [(slice(a, None, _SAMPLING), slice(b, None, _SAMPLING)) for a in (0, 1) for b in (0, 1)]
    coords = np.mean([surface.coords[part] for part in parts], axis=0)
    layer = np.stack([surface.layer[part] for part in parts])
    whole = (layer == layer[0]).all(0)
    lit = np.mean([surface.lit[part] for part in parts], axis=0) > 0.5
    coords = np.where(whole[..., None], coords, surface.coords[parts[0]])
    return np.where(lit[..., None], coords, np.float32(np.nan))


def fit(features: Float32[ndarray, "n 5"], wrong: Bool[ndarray, "n"]) -> tuple[Float32[ndarray, "5"], float]:
    """Weights and bias of the logistic model with the highest likelihood."""
    mean, spread = features.mean(0), features.std(0)
    x, y = torch.from_numpy((features - mean) / spread), torch.from_numpy(wrong.astype(np.float32))
    weight = torch.zeros(features.shape[1] + 1, requires_grad=True)
    optimizer = torch.optim.LBFGS([weight], max_iter=200, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        optimizer.zero_grad()
        value = torch.nn.functional.binary_cross_entropy_with_logits(x @ weight[:-1] + weight[-1], y)
        value.backward()
        return value

    optimizer.step(loss)
    scaled = weight.detach().numpy()
    own = (scaled[:-1] / spread).astype(np.float32)
    return own, float(scaled[-1] - own @ mean)


def train(config: Config) -> None:
    """Train and write `reliability.safetensors` and `log.jsonl` into the output folder."""
    torch.set_num_threads(config.threads)
    cv2.setNumThreads(1)
    config.output.mkdir(parents=True, exist_ok=True)
    found = [one for number in range(config.captures) if (one := examples(config, number)) is not None]
    features, wrong = (np.concatenate(part) for part in zip(*found[::2], strict=True))
    weight, bias = fit(features, wrong)
    features, wrong = (np.concatenate(part) for part in zip(*found[1::2], strict=True))
    chance = 1 / (1 + np.exp(-(features @ weight + bias)))
    for most in (0.05, 0.1, 0.2, 0.3, 0.5, 1.0):
        kept = chance <= most
        log_row(config.output, {"captures": len(found), "most": most, "kept": round(float(kept.mean()), 4),
                                "wrong": round(float(wrong[kept].mean()), 5)})  # fmt: skip
    values = {"weight": torch.from_numpy(weight), "bias": torch.tensor(bias)}
    save_file(values, config.output / "reliability.safetensors", settings(config))


if __name__ == "__main__":
    train(tyro.cli(Config, description=__doc__))
