"""Photographs of random objects, rendered as sl-synth does: shadows, hidden parts and borders as they are in space."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.scan.images import as_grey
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.devices import disturb_image
from sl_nerfstudio.synthesis.synthesise import GAIN, make_setup
from training.noise_fields import log_uniform
from training.objects import random_object
from training.patterns import seeded_grid

_SUPERSAMPLING = 2
_PERIODS = (9.0, 19.0)  # pixels, where the object is


@dataclass(frozen=True)
class Rendered:
    """A grey photograph, the pattern, true pattern pixels, NaN where it is not, and both devices."""

    image: Float32[ndarray, "h w"]
    grid: GridPattern
    true: Float32[ndarray, "h w 2"]
    camera: Device
    projector: Device


def rendered_captures(seed: int, number: int, frames: int) -> Iterator[Rendered]:
    """Photographs of one random object under one random pattern, from all around."""
    rng = np.random.default_rng([seed, 9, number])
    grid = seeded_grid(rng)
    size = round(log_uniform(rng, *_PERIODS) * grid.columns)
    with TemporaryDirectory() as folder:
        mesh, pattern = Path(folder) / "object.ply", Path(folder) / "pattern.json"
        random_object(rng).export(mesh)
        pattern.write_bytes(grid.encode())
        config = SynthConfig(
            scene=str(mesh),
            appearance=rng.choice(["plain", "realistic", "hard"], p=(0.3, 0.4, 0.3)),
            background=rng.choice(["none", "table", "walls"], p=(0.4, 0.3, 0.3)),
            frames=frames,
            resolution=size,
            pattern=pattern,
            seed=int(rng.integers(1 << 31)),
            images_only=True,
        )
        setup = make_setup(config)
    devices = setup.devices.camera, setup.devices.projector
    for frame in range(frames):
        if setup.photography is not None:
            photo = setup.photograph(frame, _SUPERSAMPLING, setup.photography, config.seed)
            yield Rendered(as_grey(photo.image), grid, photo.coords, *devices)
        else:
            view = setup.render(frame, _SUPERSAMPLING)
            image = disturb_image(view.radiance, GAIN, config.sensor_noise, rng)
            yield Rendered(as_grey(image), grid, view.coords, *devices)
