"""What differs from frame to frame: exposure, motion, compression, and which frames are of no use."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Float64
from numpy import ndarray

from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.se3 import exp_so3
from sl_nerfstudio.synthesis.appearance.ranges import Ranges, draw, draw_log

Fault = Literal["object out of view", "blurred by motion"]
_AWAY_DEG = (24.0, 40.0)  # that the camera is turned away from the object


@dataclass(frozen=True)
class Shot:
    """One frame; `fault` says why it is of no use."""

    exposure: float  # times the one that suits the object
    motion: float  # pixels of an image 600 pixels wide
    motion_direction: float  # in the image, radians
    jpeg_quality: int
    fault: Fault | None = None


def plan_shots(ranges: Ranges, rngs: list[np.random.Generator], useless: frozenset[int]) -> tuple[Shot, ...]:
    """Each frame from its own stream; those in `useless` are spoiled one way or the other."""
    return tuple(_shot(ranges, rng, frame in useless) for frame, rng in enumerate(rngs))


def choose_useless(frames: int, ranges: Ranges, rng: np.random.Generator) -> frozenset[int]:
    """Frames of no use: the share that the ranges give, rounded at random, and never the first."""
    wanted = ranges.useless * frames
    count = int(wanted) + int(rng.random() < wanted % 1)
    return frozenset(int(n) for n in 1 + rng.permutation(frames - 1)[:count])


def turn_away(poses: DevicePoses, shots: tuple[Shot, ...], rngs: list[np.random.Generator]) -> DevicePoses:
    """The camera looks past the object in frames that say so."""
    camera = poses.T_world_camera.copy()
    for n, (shot, rng) in enumerate(zip(shots, rngs, strict=True)):
        if shot.fault == "object out of view":
            camera[n] = camera[n] @ _turn(rng)
    return DevicePoses(camera, poses.T_world_projector)


def _shot(ranges: Ranges, rng: np.random.Generator, useless: bool) -> Shot:
    exposure, motion = draw_log(rng, ranges.exposure), draw(rng, ranges.motion)
    direction, quality = float(rng.uniform(0, np.pi)), round(draw(rng, ranges.jpeg_quality))
    if not useless:
        return Shot(exposure, motion, direction, quality)
    if rng.random() < 0.5:
        return Shot(exposure, motion, direction, quality, "object out of view")
    return Shot(exposure, draw(rng, ranges.shake), direction, quality, "blurred by motion")


def _turn(rng: np.random.Generator) -> Float64[ndarray, "4 4"]:
    """A rotation of a device about a random axis across its line of sight."""
    import torch

    angle, axis = np.radians(draw(rng, _AWAY_DEG)), rng.uniform(0, 2 * np.pi)
    T = np.eye(4)
    w: Float[ndarray, 3] = angle * np.array([np.cos(axis), np.sin(axis), 0.0])
    T[:3, :3] = exp_so3(torch.from_numpy(w)).numpy()
    return T
