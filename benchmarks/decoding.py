"""The network decoder on rendered captures, with exact truth, of objects that it was not trained on.

    python -m benchmarks.decoding [--scenes head frog] [--resolutions 400 800] [--frames 8] [--output results.json]

Captures are those that sl-synth renders (`plain`), and such with much noise, blur, texture and room light (`strong`).
"""

import time
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float32
from numpy import ndarray

from benchmarks.common.measuring import Rows, parsed
from sl_nerfstudio.decoding.decoder import DecodingError
from sl_nerfstudio.decoding.grid import GridImageDecoder
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.devices import disturb_image
from sl_nerfstudio.synthesis.synthesise import GAIN, Stream, make_setup, random_stream

CONDITIONS = {  # sensor noise at full scale; blur, albedo contrast and light of the room
    "plain": (0.012, {"blur": 0.55, "albedo_contrast": 0.16, "room_light": 0.08}),
    "strong": (0.05, {"blur": 1.3, "albedo_contrast": 0.40, "room_light": 0.30}),  # blur for a period of ten pixels
}


@dataclass(frozen=True)
class Config:
    """Share decoded, error and share wrong of the network decoder."""

    scenes: tuple[str, ...] = ("cone-and-cylinder", "head", "frog")
    resolutions: tuple[int, ...] = (400, 800)
    frames: int = 8  # of each scene and resolution, from all sides
    doe: bool = False  # a diffractive projector instead of a pinhole
    seed: int = 5
    output: Path | None = None


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


def measure(config: Config, conditions: str, scene: str, resolution: int) -> Row:
    """Render captures, decode them, and compare with the truth."""
    setup = make_setup(SynthConfig(
        scene=scene, frames=max(config.frames, 2), resolution=resolution, seed=config.seed,
        projector_model="DOE" if config.doe else "OPENCV",
    ))  # fmt: skip
    sensor_noise, look = CONDITIONS[conditions]
    if conditions != "plain":
        look = {**look, "blur": look["blur"] * resolution / 400}
    setup = replace(setup, appearance=replace(setup.appearance, **look))
    grid = GridPattern()  # the pattern that sl-synth projects by default
    decoder = GridImageDecoder(grid)
    lit, outside, failed, errors, periods, seconds = 0, 0, 0, [np.zeros(0, np.float32)], [], []
    for index in range(config.frames):
        truth = setup.render(index, 2)
        image = disturb_image(truth.radiance, GAIN, sensor_noise, random_stream(config.seed, Stream.SENSOR, index))
        periods.append(_period(truth.coords, grid.period))
        lit += int(truth.mask.sum())
        start = time.perf_counter()
        try:
            decoded = decoder.decode(image)
        except DecodingError as problem:
            print(problem)
            failed += 1
            seconds.append(0.0)
            continue
        seconds.append(time.perf_counter() - start)
        both = decoded.decoded & truth.mask
        errors.append(np.linalg.norm(decoded.coords[both] - truth.coords[both], axis=-1))
        outside += int((decoded.decoded & ~truth.mask).sum())
    error = np.concatenate(errors)
    return Row(
        conditions, scene, resolution, round(float(np.median(periods)), 1), round(len(error) / lit, 4),
        round(float(np.median(error)), 3), round(float(np.quantile(error, 0.9)), 3),
        round(float(np.mean(error > grid.period / 2)), 5), round(outside / max(outside + len(error), 1), 5), failed,
        round(float(np.mean(seconds)), 2),
    )  # fmt: skip


def _period(coords: Float32[ndarray, "h w 2"], period: float) -> float:
    """Median width of a period in the image, in pixels."""
    right, down = coords[:-1, 1:] - coords[:-1, :-1], coords[1:, :-1] - coords[:-1, :-1]
    area = np.abs(right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0])
    return period / float(np.sqrt(np.nanmedian(area)))


def main() -> None:
    """Print a line for each case, and write all to JSON."""
    config = parsed(Config, __doc__)
    torch.set_num_threads(2)
    cv2.setNumThreads(2)
    rows: Rows[Row] = Rows(config.output)
    for conditions in CONDITIONS:
        for resolution in config.resolutions:
            for scene in config.scenes:
                rows.add(measure(config, conditions, scene, resolution))


if __name__ == "__main__":
    main()
