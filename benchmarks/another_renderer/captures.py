"""A set of captures: the walk around the object, the photographs, and the truth beside them."""

import json
import os
import shutil
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import trimesh
from numpy import ndarray

from benchmarks.another_renderer.objects import OBJECTS
from benchmarks.another_renderer.optics import Lens, looking
from benchmarks.another_renderer.photograph import Look, Projection, View, photograph
from benchmarks.another_renderer.scene import Paint, Scene, surroundings
from benchmarks.another_renderer.sensor import jpeg


@dataclass(frozen=True)
class Walk:
    """How the devices move, and how far they are."""

    name: str = ""
    turn_deg: float = 360.0  # of the camera about the object, first to last frame
    elevation_deg: float = 32.0  # about which the camera goes up and down by 12
    apart_deg: tuple[float, float] = 15.0, 27.0  # between camera and projector, seen from the object
    roll: float = 0.15  # of the camera, radians at most
    zoom: float = 1.0  # focal lengths and distances, relative to the usual ones
    distances: tuple[float, float] = 0.92, 1.15  # of both devices, relative to the usual ones
    nearer: float = 1.0  # the camera's distances, relative to those: below 1 it sees only part of the object
    aim: float = 0.03  # how far from the middle both devices aim at most, in each direction, share of its size


@dataclass(frozen=True)
class Equipment:
    """Camera and projector."""

    name: str = ""
    aspect: float = 1.0  # width over height of the camera's images
    distortion: tuple[float, float] = -0.06, 0.02  # k1 of the camera
    lens_shift: float = 0.0  # of the projector, heights of its image: 0.5 puts its axis at the lower border
    projector_distortion: float = 0.0  # k1


@dataclass(frozen=True)
class CaptureSet:
    """One set; `missed` are photographs in which the object is out of view."""

    thing: str
    around: str  # "none", "table" or "room"
    look_name: str
    seed: int
    look: Look = field(default_factory=Look, compare=False)
    frames: int = 24
    missed: tuple[int, ...] = ()
    shuffled: bool = False
    resolution: int = 600
    walk: Walk = Walk()
    equipment: Equipment = Equipment()

    @property
    def name(self) -> str:
        """Unique."""
        size = "" if self.resolution == 600 else str(self.resolution)
        ends = (self.walk.name, self.equipment.name, "shuffled" if self.shuffled else "", size)
        return "-".join([self.thing, self.around, self.look_name, str(self.seed), *filter(None, ends)])


def lenses(one: CaptureSet, pattern: ndarray, rng: np.random.Generator) -> tuple[Lens, Lens]:
    """Camera and projector, both a little off centre, the camera's with distortion."""
    zoom, how, size, (h, w) = one.walk.zoom, one.equipment, one.resolution, pattern.shape
    width, height = round(size * how.aspect**0.5), round(size / how.aspect**0.5)
    f = 1.5 * zoom * size * rng.uniform(0.97, 1.05)
    cx, cy = rng.uniform(0.49, 0.51, 2) * [width, height]
    camera = Lens(width, height, f, cx, cy, rng.uniform(*how.distortion), rng.uniform(-0.02, 0.02))
    f = 1.42 * zoom * w * rng.uniform(0.97, 1.03)
    cx, cy = w * rng.uniform(0.49, 0.51), h * (rng.uniform(0.49, 0.53) + how.lens_shift)
    return camera, Lens(w, h, f, cx, cy, how.projector_distortion)


def walk(one: CaptureSet, thing: trimesh.Trimesh, rng: np.random.Generator) -> list[View]:
    """Around it; both devices move by themselves, and the projector is now on one side, now on another."""
    how = one.walk
    low, high = thing.bounds
    middle, size = (low + high) / 2, float(np.linalg.norm(high - low))
    views, side, phase = [], rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi)
    for k in range(one.frames):
        azimuth = np.radians(how.turn_deg) * k / one.frames + rng.uniform(-0.06, 0.06)
        elevation = np.radians(how.elevation_deg + 12 * np.sin(1.7 * azimuth + phase) + rng.uniform(-4, 4))
        side += rng.uniform(-0.5, 0.5)
        apart = np.radians(rng.uniform(*how.apart_deg))
        far_camera, far_projector = size * 1.45 * how.zoom * rng.uniform(*how.distances, 2) * [how.nearer, 1.0]
        eye = _direction(azimuth, elevation)
        across = _direction(azimuth + np.pi / 2, 0.0)
        way = np.cos(side) * across + 0.6 * np.sin(side) * np.cross(eye, across)
        from_projector = np.cos(apart) * eye + np.sin(apart) * way / np.linalg.norm(way)
        aims = middle + size * rng.uniform(-how.aim, how.aim, (2, 3))
        if k in one.missed:
            aims[0] = middle + 1.2 * size * across
        views.append(View(
            looking(middle + far_camera * eye, aims[0], rng.uniform(-how.roll, how.roll)),
            looking(middle + far_projector * from_projector, aims[1], rng.uniform(-0.3, 0.3)),
            size * 1.45 * how.zoom * how.nearer, size * 1.45 * how.zoom,
        ))  # fmt: skip
    return views


def _direction(azimuth: float, elevation: float) -> ndarray:
    flat = np.cos(elevation)
    return np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])


def captures_of(one: CaptureSet, pattern: Path, folder: Path) -> Path:
    """The captures of a set below `folder`, made unless an earlier run did so; `pattern` is a folder of sl-pattern."""
    root = folder / one.name
    if not root.exists():
        started = folder / f".{one.name}-{os.getpid()}"
        shutil.rmtree(started, ignore_errors=True)
        _make(one, pattern, started)
        started.rename(root)
    return root


def _make(one: CaptureSet, pattern_folder: Path, root: Path) -> None:
    rng = np.random.default_rng([one.seed, 7])
    pattern = cv2.imread(str(pattern_folder / "pattern.png"), cv2.IMREAD_GRAYSCALE)
    if pattern is None:
        raise FileNotFoundError(f"{pattern_folder / 'pattern.png'}: no image; sl-pattern writes it")
    thing = OBJECTS[one.thing]()
    scene = Scene(thing, surroundings(one.around, thing, rng))
    camera, projector = lenses(one, pattern, rng)
    look = one.look
    paints = (Paint.random(look.texture, look.spots, look.colour, rng), Paint.random(0.5, True, look.colour, rng))
    projection = Projection(pattern / 255.0, projector, look)
    views = walk(one, thing, rng)
    order = rng.permutation(one.frames) if one.shuffled else np.arange(one.frames)
    for part in ("images", "truth"):
        (root / part).mkdir(parents=True)
    for place, number in enumerate(order):
        view = views[int(number)]
        view = replace(view, T_projector=view.T_projector @ projector.turned_to_middle())
        own = np.random.default_rng([one.seed, int(number)])
        values, truth = photograph(scene, camera, projection, paints, view, own)
        name = f"shot_{place:03d}"
        (root / "images" / f"{name}.jpg").write_bytes(jpeg(values, look.sensor, look.colour))
        np.savez_compressed(
            root / "truth" / f"{name}.npz", T_camera=view.T_camera, T_projector=view.T_projector,
            p_world=truth.p_world.astype(np.float32), uv_projector=truth.uv_projector.astype(np.float32),
            object_seen=truth.object_seen,
        )  # fmt: skip
    thing.export(root / "truth" / "object.ply")
    for file in ("pattern.json", "pattern.png"):
        shutil.copy(pattern_folder / file, root / file)
    devices = {
        "pixel_centre": 0.5,
        "camera": camera.document(),
        "projector": {**projector.document(), "model": "OPENCV"},
    }
    (root / "intrinsics.json").write_text(json.dumps(devices, indent=1))
