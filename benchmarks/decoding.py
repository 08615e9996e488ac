"""The network decoder on rendered captures, with exact truth, of objects that it was not trained on.

python -m benchmarks.decoding [--scenes head frog] [--resolutions 400 800] [--frames 8] [--output results.json]
"""

import json
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
import tyro
from jaxtyping import Bool, Float32
from numpy import ndarray

from benchmarks.common.machine import write_rows
from sl_nerfstudio.cli.run import run
from sl_nerfstudio.decoding.decoder import DecodingError
from sl_nerfstudio.decoding.grid import GridImageDecoder
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.devices import disturb_image
from sl_nerfstudio.synthesis.synthesise import (
    GAIN,
    Setup,
    Stream,
    make_setup,
    random_stream,
)


@dataclass(frozen=True)
class Conditions:
    """How difficult the captures are: `plain` is what sl-synth renders."""

    name: str
    sensor_noise: float  # at full scale, as a fraction of it
    blur: float  # sigma in pixels, for a period of ten pixels; grows with the period
    albedo_contrast: float
    room_light: float


CONDITIONS = (
    Conditions("plain", 0.012, 0.55, 0.16, 0.08),
    Conditions("strong", 0.05, 1.3, 0.40, 0.30),
)


@dataclass(frozen=True)
class Config:
    """Share decoded, error and share wrong of the network decoder."""

    scenes: tuple[str, ...] = ("cone-and-cylinder", "head", "frog")
    """scenes of sl-synth"""
    resolutions: tuple[int, ...] = (400, 800)
    """widths of the images, pixels"""
    frames: int = 8
    """captures of each scene and resolution, from all sides"""
    doe: bool = False
    """a diffractive projector instead of a pinhole"""
    seed: int = 5
    """seed of paths, textures and noise"""
    output: Path | None = None
    """where to write the figures as JSON, with machine, date and commit"""


@dataclass(frozen=True)
class Row:
    """Figures of one scene at one resolution; errors in projector pixels (a period is 20)."""

    conditions: str
    scene: str
    resolution: int
    period: float  # median, in pixels of the image
    decoded: float  # share of the lit pixels
    median: float
    percentile_90: float
    wrong: float  # share of the decoded pixels that are off by more than half a period
    outside: float  # share of the decoded pixels that are not lit
    failed: int  # number of frames
    seconds: float  # per frame


@dataclass(frozen=True)
class Frame:
    """Result of one capture."""

    lit: int
    error: Float32[ndarray, "n"]  # at decoded lit pixels
    outside: int
    seconds: float


def measure(config: Config, conditions: Conditions, scene: str, resolution: int) -> Row:
    """Render captures, decode them, and compare with the truth."""
    setup = harder(
        make_setup(
            SynthConfig(
                scene=scene,
                frames=max(config.frames, 2),
                resolution=resolution,
                seed=config.seed,
                projector_model="DOE" if config.doe else "OPENCV",
            )
        ),
        conditions,
        resolution,
    )
    grid = GridPattern()  # the pattern that sl-synth projects by default
    decoder = GridImageDecoder(grid)
    frames, failed, periods = [], 0, []
    for index in range(config.frames):
        truth = setup.render(index, 2)
        noise = random_stream(config.seed, Stream.SENSOR, index)
        image = disturb_image(truth.radiance, GAIN, conditions.sensor_noise, noise)
        periods.append(_period(truth.coords, grid.period))
        try:
            frames.append(_decode(decoder, image, truth.coords, truth.mask))
        except DecodingError as problem:
            print(problem)
            failed += 1
            frames.append(Frame(int(truth.mask.sum()), np.zeros(0, np.float32), 0, 0.0))
    error = np.concatenate([frame.error for frame in frames])
    outside = sum(frame.outside for frame in frames)
    return Row(
        conditions.name, scene, resolution,
        round(float(np.median(periods)), 1),
        round(len(error) / sum(frame.lit for frame in frames), 4),
        round(float(np.median(error)), 3),
        round(float(np.quantile(error, 0.9)), 3),
        round(float(np.mean(error > grid.period / 2)), 5),
        round(outside / max(outside + len(error), 1), 5),
        failed,
        round(float(np.mean([frame.seconds for frame in frames])), 2),
    )  # fmt: skip


def harder(setup: Setup, conditions: Conditions, resolution: int) -> Setup:
    """The same scene with different light, texture and lens."""
    appearance = replace(
        setup.appearance,
        blur=conditions.blur * (resolution / 400 if conditions.name != "plain" else 1.0),
        albedo_contrast=conditions.albedo_contrast,
        room_light=conditions.room_light,
    )
    return replace(setup, appearance=appearance)


def _decode(
    decoder: GridImageDecoder, image: ndarray, coords: Float32[ndarray, "h w 2"], lit: Bool[ndarray, "h w"]
) -> Frame:
    start = time.perf_counter()
    decoded = decoder.decode(image)
    seconds = time.perf_counter() - start
    both = decoded.decoded & lit
    error = np.linalg.norm(decoded.coords[both] - coords[both], axis=-1)
    return Frame(int(lit.sum()), error, int((decoded.decoded & ~lit).sum()), seconds)


def _period(coords: Float32[ndarray, "h w 2"], period: float) -> float:
    """Median width of a period in the image, in pixels."""
    right, down = coords[:-1, 1:] - coords[:-1, :-1], coords[1:, :-1] - coords[:-1, :-1]
    area = np.abs(right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0])
    return period / float(np.sqrt(np.nanmedian(area)))


def main() -> None:
    """Print a line for each case, and write all to JSON."""
    config = tyro.cli(Config, description=__doc__)
    torch.set_num_threads(2)
    cv2.setNumThreads(2)
    rows = []
    for conditions in CONDITIONS:
        for resolution in config.resolutions:
            for scene in config.scenes:
                rows.append(measure(config, conditions, scene, resolution))
                print(json.dumps(asdict(rows[-1])), flush=True)
    if config.output is not None:
        write_rows(config.output, rows)


if __name__ == "__main__":
    run(main)
