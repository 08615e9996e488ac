"""The sets: what their names mean, where both devices go, and folders of photographs with their truth."""

import json
import os
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from benchmarks.path_traced.rendering import Optics, Quality, Studio, View
from benchmarks.path_traced.sensor import Sensor, developed
from benchmarks.path_traced.shapes import FILES, MATTERS, OURS, body_of, shape_of
from benchmarks.photographs.sets import PATTERN, SET
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.scan.images import encode_png
from sl_nerfstudio.scan.types import Scale
from sl_nerfstudio.scan.write import ScanWriter, encode_intrinsics, encode_json
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.devices import DISTANCE, make_devices, make_paths
from sl_nerfstudio.synthesis.render import (
    Background,
    FrameGeometry,
    RayCaster,
    above_the_table,
    make_surroundings,
    visible_centres,
)
from sl_nerfstudio.synthesis.scenes import encode_ply
from sl_nerfstudio.synthesis.sdf import Scene


@dataclass(frozen=True)
class Camera:
    """A kind of camera, and how it is held."""

    distance: float  # from the object, in sizes of the object
    projector_distance: float  # of the projector with it: none has the field of view of a long lens
    distortion: tuple[float, float]  # k1, k2
    optics: Optics
    sensor: Sensor


CAMERAS = {
    "phone": Camera(
        2.4, 2.4, (0.04, -0.03), Optics(camera_blur=1.0, projector_blur=5.0, shake=1.0, room_light=0.12),
        Sensor(electrons=3000, read_noise=0.006, denoising=0.8, sharpening=0.7, quality=88),
    ),
    "machine": Camera(
        4.0, 4.0, (-0.12, 0.05), Optics(camera_blur=2.0, projector_blur=5.0, shake=0.3, room_light=0.05),
        Sensor(electrons=8000, read_noise=0.003, grey=True, linear=True, quality=95),
    ),
    "long": Camera(
        8.0, 3.0, (0.0, 0.0), Optics(camera_blur=4.0, projector_blur=6.0, shake=0.8, room_light=0.1),
        Sensor(electrons=6000, read_noise=0.004, quality=92),
    ),
}  # fmt: skip
"""A telephone near the object, a machine-vision camera, and a long lens far away."""
_PROJECTOR_FOCUS = 0.06  # by which the projector's focus is off in a set, share of its distance
_NAME = re.compile(r"(.+)-(none|table|walls)-([a-z]+)-([a-z]+)-(\d+)(|-shuffled|-half)")


@dataclass(frozen=True)
class PhotographSet:
    """What a name says."""

    shape: str
    around: Background
    matter: str
    camera: str
    seed: int
    order: str  # "", "shuffled" or "half"

    @staticmethod
    def named(name: str) -> "PhotographSet":
        """Raises UserError for a name that says nothing."""
        parts = _NAME.fullmatch(name)
        choices = ((*FILES, *OURS), ("none", "table", "walls"), tuple(MATTERS), tuple(CAMERAS))
        if parts is None or any(part not in some for part, some in zip(parts.groups(), choices, strict=False)):
            raise UserError(
                f"--sets {name}: a set is named SHAPE-AROUND-MATTER-CAMERA-SEED, with -shuffled at the end if its "
                "order is random, with -half if its frames go around half of the object; "
                + "; ".join(", ".join(some) for some in choices)
            )
        shape, around, matter, camera, seed, order = parts.groups()
        return PhotographSet(shape, cast(Background, around), matter, camera, int(seed), order[1:])


def photographed(name: str, frames: int, resolution: int, quality: Quality, folder: Path,
                 say: Callable[[str], None]) -> Path:  # fmt: skip
    """The folder of a set below `folder`, rendered unless an earlier run did so completely."""
    one, root = PhotographSet.named(name), folder / f"{name}-{frames}-{resolution}"
    if root.exists():
        return root
    started = folder / f".{root.name}-{os.getpid()}"
    shutil.rmtree(started, ignore_errors=True)
    try:
        _render(one, frames, resolution, quality, started, say)
        started.rename(root)
    finally:
        shutil.rmtree(started, ignore_errors=True)
    return root


def _render(one: PhotographSet, frames: int, resolution: int, quality: Quality, root: Path,
            say: Callable[[str], None]) -> None:  # fmt: skip
    rng = np.random.default_rng([one.seed, frames])
    scene, camera = shape_of(one.shape, one.seed), CAMERAS[one.camera]
    scene = scene if one.around == "none" else above_the_table(scene)
    surroundings = make_surroundings(scene, one.around, rng)
    poses = _walk(one, scene, camera, frames, rng)
    config = SynthConfig(resolution=resolution, camera_distortion=(*camera.distortion, 0.0, 0.0))
    devices, pattern = make_devices(scene, poses, (PATTERN.w, PATTERN.h), config), PATTERN.render()
    bodies = [body_of(scene, one.matter, rng)]
    if surroundings is not None:
        bodies.append(body_of(surroundings, "matte", rng))
    far = camera.distance * scene.size
    studio = Studio(bodies, devices, pattern, camera.optics, scene.size, far)
    focus = camera.projector_distance * scene.size * (1 + rng.uniform(-_PROJECTOR_FOCUS, _PROJECTOR_FOCUS))
    caster = RayCaster(scene, surroundings)
    names = _names(frames, one)
    (root / "images").mkdir(parents=True)
    with ScanWriter(root / "ground_truth", units="mm", scale=Scale(False), projector=devices.projector,
                    pattern=np.rint(255 * pattern).astype(np.uint8), camera=devices.camera) as truth:  # fmt: skip
        for k, name in enumerate(names):
            T = poses.T_world_camera[k], poses.T_world_projector[k]
            light = studio.photograph(View(*T, focus), quality, one.seed * frames + k)
            picture, file = developed(light, camera.sensor, rng)
            (root / "images" / f"{name}.jpg").write_bytes(file)
            seen = visible_centres(FrameGeometry(caster, devices, *T))
            lit, own = (mask.reshape(picture.shape[:2]) for mask in (seen.lit, caster.on_object(seen.face)))
            truth.add_frame(_numbered(k), image=picture, coords=seen.coords(devices.camera), mask=lit,
                            T_world_camera=T[0], T_world_projector=T[1])  # fmt: skip
            truth.add_file(f"object_masks/{_numbered(k)}.png", encode_png(own.astype(np.uint8) * np.uint8(255)))
            say(f"{name}: {k + 1} of {frames}")
        usable = [{"name": _numbered(k), "usable": True, "fault": None} for k in range(frames)]
        truth.add_file("captures.json", encode_json({"frames": usable}))
        for part, mesh in (("mesh", scene), ("surroundings", surroundings)):
            if mesh is not None:
                truth.add_file(f"{part}.ply", encode_ply(mesh.vertices, mesh.faces))
    (root / "pattern.png").write_bytes(encode_png(np.rint(255 * pattern).astype(np.uint8)))
    (root / "pattern.json").write_bytes(PATTERN.encode())
    (root / "intrinsics.json").write_bytes(encode_intrinsics("mm", devices.camera, devices.projector))
    note = {"unordered": False, "appearance": f"{one.matter} by {one.camera}",
            "frames": {name: k for k, name in enumerate(names)}}  # fmt: skip
    (root / SET).write_text(json.dumps(note, indent=1) + "\n")


def _walk(one: PhotographSet, scene: Scene, camera: Camera, frames: int, rng: np.random.Generator) -> DevicePoses:
    """Around the object: in the directions of `make_paths`, nearer or farther."""
    poses = make_paths(scene, frames, "half-turn" if one.order == "half" else "hand-held", rng)
    return DevicePoses(
        _at(poses.T_world_camera, scene, camera.distance / DISTANCE),
        _at(poses.T_world_projector, scene, camera.projector_distance / DISTANCE),
    )


def _at(T: Float64[ndarray, "n 4 4"], scene: Scene, factor: float) -> Float64[ndarray, "n 4 4"]:
    moved = T.copy()
    moved[:, :3, 3] = scene.centre + factor * (T[:, :3, 3] - scene.centre)
    return moved


def _numbered(k: int) -> str:
    return f"frame_{k:05d}"


def _names(frames: int, one: PhotographSet) -> list[str]:
    """Name of each frame's photograph: in the order of capture, or not."""
    places = np.random.default_rng(one.seed).permutation(frames) if one.order == "shuffled" else np.arange(frames)
    return [f"photo_{place:03d}" for place in places]
