"""Photographs of random objects, rendered as sl-synth does: shadows, hidden parts and borders as they are in space."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import trimesh
from jaxtyping import Float32, Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.scan.images import as_grey
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.devices import disturb_image
from sl_nerfstudio.synthesis.synthesise import GAIN, make_setup
from training.patterns import seeded_grid
from training.textures import log_uniform

SIZE = 120.0  # millimetres, of the longest side
_KINDS = 6
_WAVES = 6


def random_object(rng: np.random.Generator) -> trimesh.Trimesh:
    """Three to ten solids on each other, in millimetres."""
    parts = [_random_part(rng) for _ in range(rng.integers(3, 11))]
    place = np.zeros(3)
    for part in parts:
        part.apply_transform(_random_turn(rng))
        part.apply_translation(place)
        inside = part.vertices[rng.integers(len(part.vertices))]  # the next one grows out of this one
        place = place + 0.8 * (inside - place)
    mesh = trimesh.Trimesh(
        *trimesh.util.append_faces([p.vertices for p in parts], [p.faces for p in parts]), process=False
    )
    mesh.apply_translation(-mesh.bounds.mean(0))
    mesh.apply_scale(SIZE / mesh.extents.max())
    return mesh


def _random_part(rng: np.random.Generator) -> trimesh.Trimesh:
    """A lump, block, tube, plate, ring or wire."""
    kind, a, b, c = rng.integers(_KINDS), *rng.uniform(8, 40, 3)
    if kind == 0:
        part = trimesh.creation.icosphere(subdivisions=5)
        return _bumpy(rng, part.apply_scale((a, b, c)), rng.uniform(0, 0.12))
    if kind == 1:
        return trimesh.creation.box(extents=(a, b, c))
    if kind == 2:
        part = trimesh.creation.capsule(height=2 * a, radius=b / 2, count=(48, 48))
        return _bumpy(rng, part, rng.uniform(0, 0.06))
    if kind == 3:
        return trimesh.creation.box(extents=(2 * a, 1.5 * b, rng.uniform(1, 4)))
    if kind == 4:
        return trimesh.creation.torus(a, rng.uniform(0.1, 0.4) * a, major_sections=64, minor_sections=32)
    return trimesh.creation.capsule(height=3 * a, radius=rng.uniform(1.5, 6), count=(24, 24))


def _bumpy(rng: np.random.Generator, part: trimesh.Trimesh, height: float) -> trimesh.Trimesh:
    """The part with waves of `height`, as a share of its mean radius, along its normals."""
    radius = float(np.linalg.norm(part.vertices, axis=1).mean())
    wave = rng.normal(0, 1, (_WAVES, 3)) * rng.uniform(1, 6, (_WAVES, 1)) / radius
    phase = part.vertices @ wave.T + rng.uniform(0, 2 * np.pi, _WAVES)
    move = height * radius / np.sqrt(_WAVES) * np.sin(phase).sum(1)
    return trimesh.Trimesh(part.vertices + move[:, None] * part.vertex_normals, part.faces, process=False)


def _random_turn(rng: np.random.Generator) -> Float64[ndarray, "4 4"]:
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=int(rng.integers(1 << 31))).as_matrix()
    return T


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
            scene=str(mesh), appearance=rng.choice(["plain", "realistic", "hard"], p=(0.3, 0.4, 0.3)),
            background=rng.choice(["none", "table", "walls"], p=(0.4, 0.3, 0.3)), frames=frames, resolution=size,
            pattern=pattern, seed=int(rng.integers(1 << 31)), images_only=True,
        )  # fmt: skip
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
