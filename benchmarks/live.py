"""Live scans from videos of walks around an object: what is kept, how long a frame takes, and how far poses are off.

    python -m benchmarks.live [--walks round lost jolted] [--scene head] [--full] [--folder FOLDER] [--output FILE]

Each walk is rendered as a video of 640 x 480 pixels (kept in FOLDER for the next run) and given to the tracker, image
by image, as a camera would. Poses are compared with the truth after the similarity that fits all camera centres best:
a scan without a known length has no unit. With --full, the kept frames also go through `sl-process`.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64, UInt8
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.scan.write import device_fields, encode_json
from sl_nerfstudio.storage import write_atomic
from sl_nerfstudio.synthesis.appearance import Appearance, make_appearance
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.devices import DISTANCE, DevicePair, disturb_image, make_devices, make_paths
from sl_nerfstudio.synthesis.render import FrameGeometry, RayCaster, above_the_table, make_surroundings, render_capture
from sl_nerfstudio.synthesis.scenes import make_scene
from sl_nerfstudio.synthesis.synthesise import GAIN

# Walks: which place of a lap each image of the video is taken from, and what disturbs it.

LAP = 40  # places of a walk once around the object: 9 degrees apart
FRAMES_A_SECOND = 2.0  # of the videos
_SIZE = 640, 480
_NOISE = 0.012
_AWAY = Rotation.from_rotvec([0.0, np.radians(35.0), 0.0])  # the camera looks past the object
_JOLT_DEG = 7.0  # by which a jolted projector is turned about the object


@dataclass(frozen=True)
class Step:
    """One image of a walk."""

    place: int  # along the lap
    blur_px: float = 0.0  # length of a motion while it was exposed
    away: bool = False  # the object is out of view
    jolts: int = 0  # of the projector so far


def _pause(place: int, count: int, **how: float) -> list[Step]:
    return [Step(place, **how) for _ in range(count)]  # pyright: ignore[reportArgumentType]


def _round() -> list[Step]:
    """Once around, with two pauses and a few blurred images."""
    steps = [Step(k, blur_px=14.0 if k % 13 == 6 else 0.0) for k in range(LAP)]
    return steps[:12] + _pause(12, 3) + steps[12:25] + _pause(25, 3) + steps[25:]


def _lost() -> list[Step]:
    """The object is lost twice: found where it was lost, and found far back where the walk had been before."""
    there = [Step(k) for k in range(14)] + [Step(14, away=True)] * 3 + [Step(k) for k in range(15, 27)]
    return there + [Step(26, blur_px=30.0)] * 2 + [Step(26, away=True)] * 3 + [Step(k) for k in range(4, 9)]


def _jolted() -> list[Step]:
    """The projector is jolted twice, once while the camera stands still."""
    steps = [Step(k, jolts=int(k >= 9)) for k in range(20)]
    return steps + _pause(19, 2, jolts=2) + [Step(k, jolts=2) for k in range(20, 30)]


WALKS = {"round": _round, "lost": _lost, "jolted": _jolted}


@dataclass(frozen=True)
class Recording:
    """A video, the files that sl-scan needs with it, and the truth of every image."""

    folder: Path
    steps: tuple[Step, ...]
    truth: DevicePoses  # millimetres

    @property
    def video(self) -> Path:
        """The video."""
        return self.folder / "walk.avi"

    @property
    def pattern(self) -> Path:
        """Its pattern.json."""
        return self.folder / "pattern.json"

    @property
    def intrinsics(self) -> Path:
        """The intrinsics of both devices."""
        return self.folder / "intrinsics.json"


class Stage:
    """An object on a table, and two devices that see it from a lap around it."""

    def __init__(self, scene: str, seed: int, size: tuple[int, int] = _SIZE, lap: int = LAP) -> None:
        w, h = size
        config = SynthConfig(scene, background="table", resolution=h, seed=seed)
        self.scene = above_the_table(make_scene(scene, 1.0, seed))
        self.poses = make_paths(self.scene, lap, "hand-held", np.random.default_rng([seed, 1]))
        self.pattern = GridPattern()
        square = make_devices(self.scene, self.poses, (self.pattern.w, self.pattern.h), config)
        wide = replace(square.camera, w=w, h=h, cx=square.camera.cx + (w - h) / 2)
        self.devices = DevicePair(wide, square.projector)
        surroundings = make_surroundings(self.scene, "table", np.random.default_rng([seed, 2]))
        self._caster = RayCaster(self.scene, surroundings)
        self._picture, self._seed = self.pattern.render(), seed
        rng = np.random.default_rng([seed, 3])
        self._appearance: Appearance = make_appearance(self.scene, DISTANCE * self.scene.size, rng)

    def poses_of(self, step: Step) -> tuple[Float64[ndarray, "4 4"], Float64[ndarray, "4 4"]]:
        """`T_world_camera` and `T_world_projector` of an image."""
        T_world_camera, T_world_projector = (
            T[step.place].copy() for T in (self.poses.T_world_camera, self.poses.T_world_projector)
        )
        if step.away:
            T_world_camera[:3, :3] = T_world_camera[:3, :3] @ _AWAY.as_matrix()
        turn = Rotation.from_rotvec([0.0, 0.0, np.radians(_JOLT_DEG * step.jolts)]).as_matrix()
        T_world_projector[:3, :3] = turn @ T_world_projector[:3, :3]
        centre = self.scene.centre
        T_world_projector[:3, 3] = centre + turn @ (T_world_projector[:3, 3] - centre)
        return T_world_camera, T_world_projector

    def image(self, step: Step, number: int, noise: float = _NOISE) -> UInt8[ndarray, "h w"]:
        """The image, grey, with the sensor's noise."""
        geometry = FrameGeometry(self._caster, self.devices, *self.poses_of(step))
        radiance = render_capture(geometry, self._picture, self._appearance, 2).radiance
        if step.blur_px:
            kernel = np.zeros((1, 2 * round(step.blur_px / 2) + 1), dtype=np.float32)
            kernel[:] = 1 / kernel.size
            radiance = np.asarray(cv2.filter2D(radiance, -1, kernel))
        return disturb_image(radiance, GAIN, noise, np.random.default_rng([self._seed, 4, number]))

    def intrinsics(self) -> bytes:
        """The file with the intrinsics of both devices."""
        camera, projector = self.devices.camera, self.devices.projector
        own = {**device_fields(projector, "model"), "pattern_path": "pattern.png"}
        return encode_json({"units": "mm", **device_fields(camera, "camera_model"), "projector": own})


def record(folder: Path, scene: str, steps: Sequence[Step], seed: int) -> Recording:
    """Render a walk as a video with its files, unless the folder has it."""
    stage = Stage(scene, seed)
    poses = [stage.poses_of(step) for step in steps]
    truth = DevicePoses(np.stack([camera for camera, _ in poses]), np.stack([projector for _, projector in poses]))
    found = Recording(folder, tuple(steps), truth)
    note = repr((scene, seed, steps)).encode()
    done = folder / "walk.txt"
    if done.exists() and done.read_bytes() == note:
        return found
    folder.mkdir(parents=True, exist_ok=True)
    write_atomic(found.pattern, stage.pattern.encode())
    write_atomic(found.intrinsics, stage.intrinsics())
    writer = cv2.VideoWriter(str(found.video), cv2.VideoWriter.fourcc(*"MJPG"), FRAMES_A_SECOND, _SIZE)
    for number, step in enumerate(steps):
        writer.write(np.repeat(stage.image(step, number)[..., None], 3, -1))
    writer.release()
    write_atomic(done, note)
    return found
