"""Poses of camera and projector in each frame: smooth paths around the object, as if hand-held."""

from typing import Literal

import numpy as np
from jaxtyping import Float, Float64
from numpy import ndarray

from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.synthesis.scenes.scene import Scene

PathKind = Literal["hand-held", "rigid-rig", "static-projector"]
DISTANCE = 4.5  # of the devices from the object, in sizes of the object
_DISTANCE_SWING = 0.06
_BASELINE = (0.75, 1.5)  # in sizes of the object
_AIM_SWING = 0.03  # how far a device aims off the centre, in sizes of the object
_CAMERA_ROLL, _PROJECTOR_ROLL = np.radians(25.0), np.radians(35.0)
_FRAMES_A_LAP = 30


def make_paths(scene: Scene, frames: int, kind: PathKind, rng: np.random.Generator) -> DevicePoses:
    """Poses of `frames` captures, in millimetres, about the scene's centre.

    hand-held: both devices move independently, so their relative pose differs in every frame; rigid-rig: one relative
    pose for all; static-projector: the projector does not move, the camera circles around the projector's axis.
    """
    t = np.arange(frames) / frames
    if kind == "static-projector":
        return _about_a_projector(scene, t, rng)
    camera = _around_the_object(scene, t, rng)
    if kind == "rigid-rig":
        T_camera_projector = _rig(scene)
        return DevicePoses(camera, camera @ T_camera_projector)
    return DevicePoses(camera, _beside(scene, camera, t, rng))


def look_at(
    position: Float[ndarray, "*n 3"], target: Float[ndarray, "*#n 3"], roll: Float[ndarray, "*n"]
) -> Float64[ndarray, "*n 4 4"]:
    """Pose of a device at `position` that looks at `target`; `roll` (radians) rotates it about its axis."""
    back = position - target
    back = back / np.linalg.norm(back, axis=-1, keepdims=True)
    # looking straight up or down, any horizontal direction may be "up"
    up = np.where(np.abs(back[..., 2:]) > 0.999, [0.0, 1.0, 0.0], [0.0, 0.0, 1.0])
    right = np.cross(up, back)
    right = right / np.linalg.norm(right, axis=-1, keepdims=True)
    above = np.cross(back, right)
    c, s = np.cos(roll)[..., None], np.sin(roll)[..., None]
    T = np.zeros((*back.shape[:-1], 4, 4))
    T[..., :3, 0] = c * right + s * above
    T[..., :3, 1] = c * above - s * right
    T[..., :3, 2] = back
    T[..., :3, 3] = position
    T[..., 3, 3] = 1.0
    return T


def wander(t: Float[ndarray, "n"], rng: np.random.Generator, cycles: float = 3.0) -> Float[ndarray, "n"]:
    """A smooth random function of `t` in [0, 1], with values in [-1, 1] and up to about `cycles` oscillations."""
    k = np.arange(1, 5)
    frequency = cycles * k / 4
    phase = rng.uniform(0, 2 * np.pi, 4)
    weight = rng.uniform(0.5, 1.0, 4)
    waves = np.sin(2 * np.pi * frequency * t[:, None] + phase)
    return waves @ weight / weight.sum()


def _direction(azimuth: Float[ndarray, "n"], elevation: Float[ndarray, "n"]) -> Float[ndarray, "n 3"]:
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], -1)


def _distance(scene: Scene, t: Float[ndarray, "n"], rng: np.random.Generator) -> Float[ndarray, "n"]:
    return DISTANCE * scene.size * (1 + _DISTANCE_SWING * wander(t, rng))


def _aim(scene: Scene, t: Float[ndarray, "n"], rng: np.random.Generator) -> Float[ndarray, "n 3"]:
    swing = np.stack([wander(t, rng, 4.0) for _ in range(3)], -1)
    return scene.centre + _AIM_SWING * scene.size * swing


def _around_the_object(scene: Scene, t: Float[ndarray, "n"], rng: np.random.Generator) -> Float64[ndarray, "n 4 4"]:
    """Laps around the object, up and down between the scene's lowest and highest elevation."""
    laps = max(1, round(len(t) / _FRAMES_A_LAP))
    azimuth = rng.uniform(0, 2 * np.pi) + 2 * np.pi * laps * t + np.radians(4.0) * wander(t, rng, 5.0)
    low, high = np.radians(scene.elevation_deg)
    swing = np.sin(2 * np.pi * (2 * laps + 0.5) * t + rng.uniform(0, 2 * np.pi))
    height = np.clip(0.85 * swing + 0.3 * wander(t, rng), -1, 1)
    elevation = (low + high) / 2 + (high - low) / 2 * height
    position = scene.centre + _distance(scene, t, rng)[:, None] * _direction(azimuth, elevation)
    return look_at(position, _aim(scene, t, rng), _CAMERA_ROLL * wander(t, rng, 4.0))


def _beside(
    scene: Scene, T_world_camera: Float64[ndarray, "n 4 4"], t: Float[ndarray, "n"], rng: np.random.Generator
) -> Float64[ndarray, "n 4 4"]:
    """A projector in the other hand: its distance from the camera and its side change all the time."""
    offset = T_world_camera[:, :3, 3] - scene.centre
    camera_distance = np.linalg.norm(offset, axis=-1)
    distance = _distance(scene, t, rng)
    shortest, longest = np.array(_BASELINE) * scene.size
    baseline = (shortest + longest) / 2 + (longest - shortest) / 2 * np.clip(1.3 * wander(t, rng, 4.0), -1, 1)
    side = rng.choice([-1.0, 1.0])
    bearing = side * np.radians(80.0 + 60.0 * wander(t, rng, 3.0))  # 0: the projector is above the camera
    cos = (camera_distance**2 + distance**2 - baseline**2) / (2 * camera_distance * distance)
    angle = np.arccos(np.clip(cos, -1, 1))
    out = offset / camera_distance[:, None]
    position = scene.centre + distance[:, None] * _tilt(out, angle, bearing)
    return look_at(position, _aim(scene, t, rng), _PROJECTOR_ROLL * wander(t, rng, 3.0))


def _tilt(
    out: Float[ndarray, "n 3"], angle: Float[ndarray, "n"], bearing: Float[ndarray, "n"]
) -> Float[ndarray, "n 3"]:
    """Unit directions `angle` away from `out`, towards `bearing` (0 is up, clockwise seen from outside)."""
    T = look_at(out, np.zeros(3), np.zeros(len(out)))
    towards = np.cos(bearing)[:, None] * T[:, :3, 1] + np.sin(bearing)[:, None] * T[:, :3, 0]
    return np.cos(angle)[:, None] * out + np.sin(angle)[:, None] * towards


def _rig(scene: Scene) -> Float64[ndarray, "4 4"]:
    """The projector relative to the camera: to the right and slightly above, aimed at the object."""
    distance = DISTANCE * scene.size
    position = np.array([1.0, 0.25, 0.0]) * scene.size
    T = np.eye(4)
    back = position - np.array([0.0, 0.0, -distance])
    back = back / np.linalg.norm(back)
    right = np.cross([0.0, 1.0, 0.0], back)
    right = right / np.linalg.norm(right)
    T[:3, :3] = np.stack([right, np.cross(back, right), back], -1)
    T[:3, 3] = position
    return T


def _about_a_projector(scene: Scene, t: Float[ndarray, "n"], rng: np.random.Generator) -> DevicePoses:
    """A projector that does not move, and a camera that circles around its axis, nearer and farther."""
    azimuth, elevation = np.array([rng.uniform(0, 2 * np.pi)]), np.radians([50.0])
    out = _direction(azimuth, elevation)
    projector = look_at(scene.centre + DISTANCE * scene.size * out, scene.centre, np.radians([rng.uniform(-20, 20)]))
    laps = max(2, round(len(t) / 12))
    angle = np.radians(22.0 + 10.0 * wander(t, rng))
    bearing = rng.uniform(0, 2 * np.pi) + 2 * np.pi * laps * t
    direction = _tilt(np.broadcast_to(out, (len(t), 3)), angle, bearing)
    position = scene.centre + _distance(scene, t, rng)[:, None] * direction
    camera = look_at(position, _aim(scene, t, rng), _CAMERA_ROLL * wander(t, rng, 4.0))
    return DevicePoses(camera, np.repeat(projector, len(t), axis=0))
