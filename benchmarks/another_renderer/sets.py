"""The sets, the walk around the object, the photographs, and the truth beside them."""

import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import trimesh
from numpy import ndarray

from benchmarks.another_renderer.objects import OBJECTS
from benchmarks.another_renderer.photograph import (
    Lens,
    Look,
    Paint,
    Projection,
    Scene,
    Sensor,
    View,
    jpeg,
    looking,
    photograph,
    surroundings,
)  # fmt: skip


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
    frames: int = 24
    missed: tuple[int, ...] = ()
    shuffled: bool = False
    resolution: int = 600
    walk: Walk = Walk()
    equipment: Equipment = Equipment()

    @property
    def look(self) -> Look:
        """How difficult its photographs are."""
        return LOOKS[self.look_name]

    @property
    def name(self) -> str:
        """A unique name."""
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
        "pixel_centre": 0.5, "camera": camera.document(), "projector": {**projector.document(), "model": "OPENCV"},
    }  # fmt: skip
    (root / "intrinsics.json").write_text(json.dumps(devices, indent=1))


LOOKS = {
    "clean": Look(),
    "photo": Look(
        room_light=0.15, texture=0.35, gloss=0.06, projector_blur=0.8, projector_defocus=1.2, contrast=0.95,
        sensor=Sensor(blur_px=0.6, defocus_px=0.8, electrons=6000, read_noise=0.004, exposure_stops=0.4, quality=90),
    ),
    "rough": Look(
        room_light=0.2, texture=0.55, spots=True, colour=True, gloss=0.2, projector_blur=1.0, projector_defocus=1.6,
        contrast=0.9,
        sensor=Sensor(blur_px=0.8, defocus_px=1.5, motion_px=2.0, electrons=2500, read_noise=0.008,
                      exposure_stops=0.7, quality=80),
    ),
    "phone": Look(
        room_light=0.2, texture=0.4, colour=True, gloss=0.08, projector_blur=0.8, projector_defocus=1.2, contrast=0.93,
        sensor=Sensor(blur_px=0.7, defocus_px=0.8, motion_px=1.0, electrons=2500, read_noise=0.006, exposure_stops=0.4,
                      quality=85, vignetting=0.35, denoising_px=1.5, sharpening=0.9, tone=0.6, thinned_colour=True),
    ),
    "wax": Look(
        room_light=0.1, texture=0.25, gloss=0.15, projector_blur=0.8, contrast=0.95, translucent=0.45, scatter_px=4.0,
        sensor=Sensor(blur_px=0.6, electrons=6000, read_noise=0.004, quality=92),
    ),
    "bounce": Look(
        room_light=0.1, texture=0.3, gloss=0.06, projector_blur=0.8, contrast=0.95, bounces=True,
        sensor=Sensor(blur_px=0.6, defocus_px=0.8, electrons=6000, read_noise=0.004, exposure_stops=0.4, quality=90),
    ),
}  # fmt: skip
LANDSCAPE = Equipment("landscape", aspect=16 / 9, distortion=(-0.16, -0.12))
PORTRAIT = Equipment("portrait", aspect=3 / 4)
SHIFTED = Equipment("lens-shift", lens_shift=0.55, projector_distortion=-0.06)


KNOWN = (  # may be looked at while something is changed
    CaptureSet("mug", "table", "photo", 15), CaptureSet("box", "none", "clean", 16),
    CaptureSet("nut", "none", "clean", 17), CaptureSet("gear", "none", "clean", 18),
    CaptureSet("bracket", "table", "clean", 12), CaptureSet("sticks", "room", "rough", 14, missed=(3, 10, 11, 19)),
    CaptureSet("foot", "none", "photo", 21), CaptureSet("relief", "table", "photo", 22),
    CaptureSet("wire", "table", "photo", 23), CaptureSet("pair", "table", "clean", 24),
)  # fmt: skip
UNSEEN = (  # nobody looks at these before a change is finished
    CaptureSet("knot", "none", "clean", 31), CaptureSet("blob", "room", "photo", 32, missed=(4, 5, 12, 13, 20, 21)),
    CaptureSet("jaw", "table", "photo", 33), CaptureSet("bust", "room", "rough", 34),
    CaptureSet("blade", "table", "photo", 35), CaptureSet("housing", "table", "rough", 36, shuffled=True),
    CaptureSet("bottle", "none", "photo", 37), CaptureSet("vertebra", "none", "photo", 38, shuffled=True),
    CaptureSet("cloth", "table", "clean", 39), CaptureSet("steps", "room", "clean", 40),
)  # fmt: skip
OTHERWISE = (  # people walk otherwise
    CaptureSet("housing", "none", "photo", 51, frames=16, walk=Walk("half-turn", turn_deg=180.0)),
    CaptureSet("vertebra", "table", "photo", 52, frames=14, walk=Walk("few-frames")),
    CaptureSet("jaw", "none", "photo", 53, walk=Walk("long-lens", zoom=2.5)),
    CaptureSet("bust", "table", "photo", 54, walk=Walk("short-baseline", apart_deg=(5.0, 9.0))),
    CaptureSet("knot", "table", "photo", 55, walk=Walk("long-baseline", apart_deg=(30.0, 42.0))),
    CaptureSet("bracket", "none", "photo", 56, resolution=400),
    CaptureSet("foot", "table", "rough", 57, resolution=1000),
    CaptureSet("pair", "table", "photo", 58, walk=Walk("from-above", elevation_deg=62.0)),
    CaptureSet("cloth", "none", "photo", 59, shuffled=True, walk=Walk("rolled", roll=3.14)),
    CaptureSet("sticks", "none", "photo", 60, frames=40, walk=Walk("two-rounds", turn_deg=720.0)),
)
LATER = (  # objects that came when everything had been chosen
    CaptureSet("hand", "table", "photo", 71), CaptureSet("car", "table", "rough", 72, shuffled=True),
    CaptureSet("shoe", "room", "photo", 73), CaptureSet("knight", "none", "rough", 74, shuffled=True),
    CaptureSet("shell", "table", "photo", 75, frames=20, walk=Walk("two-rounds", turn_deg=720.0)),
    CaptureSet("pan", "none", "photo", 76), CaptureSet("pan", "table", "rough", 77),
    CaptureSet("hand", "none", "rough", 78, frames=16, walk=Walk("half-turn", turn_deg=180.0)),
)  # fmt: skip
EQUIPMENT = (  # other cameras, projectors and matter; pictures that a telephone has worked on; partial views
    CaptureSet("jaw", "table", "photo", 81, walk=Walk("farther", nearer=1.2), equipment=LANDSCAPE),
    CaptureSet("shoe", "room", "phone", 82, equipment=PORTRAIT),
    CaptureSet("car", "table", "photo", 83, equipment=SHIFTED),
    CaptureSet("bust", "none", "photo", 84, frames=36, walk=Walk("close", turn_deg=720.0, nearer=0.5, aim=0.12)),
    CaptureSet("hand", "table", "rough", 85, walk=Walk("near-and-far", distances=(0.65, 1.6))),
    CaptureSet("vertebra", "none", "wax", 86),
    CaptureSet("bracket", "room", "bounce", 87),
    CaptureSet(
        "foot", "room", "phone", 88, shuffled=True, walk=Walk("near-and-far", distances=(0.75, 1.4)), equipment=SHIFTED
    ),
)
LISTS = {"known": KNOWN, "unseen": UNSEEN, "otherwise": OTHERWISE, "later": LATER, "equipment": EQUIPMENT}


def chosen_sets(parts: Sequence[str], which: str) -> list[CaptureSet]:
    """Sets of one of the lists whose names contain one of the parts, or all. Raises ValueError for a part in none."""
    sets = LISTS[which]
    for part in parts:
        if not any(part in one.name for one in sets):
            raise ValueError(f"--sets {part}: no set is named so; there are {', '.join(one.name for one in sets)}")
    return [one for one in sets if not parts or any(part in one.name for part in parts)]
