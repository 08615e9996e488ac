"""Synthetic sets under a projector with lens shift: decoded coordinates with noise, and the truth."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.devices import (
    CoordinateNoise,
    DevicePair,
    PathKind,
    disturb_coords,
    make_devices,
    make_paths,
    pixels,
)
from sl_nerfstudio.synthesis.render import FrameGeometry, RayCaster, visible_centres
from sl_nerfstudio.synthesis.scenes import make_scene
from sl_nerfstudio.synthesis.synthesise import make_cells

PATTERN = (1280, 800)
NOISE = CoordinateNoise(sigma=0.3, missing=0.15, wrong=0.02)


@dataclass(frozen=True)
class SetOptions:
    """One set."""

    scene: str = "head"
    seed: int = 0
    frames: int = 12
    shift: float = 1.2  # of the principal point below the middle of the image, in image heights
    aspect: float = 1.0  # fl_y over fl_x
    k1: float = 0.0
    path: PathKind = "hand-held"
    noise: CoordinateNoise = NOISE
    resolution: int = 400


@dataclass(frozen=True)
class CoordinateSet:
    """Decoded coordinates of all frames, with the truth; lengths in millimetres."""

    devices: DevicePair
    poses: DevicePoses
    coords: tuple[Float32[ndarray, "h w 2"], ...]  # as decoded; NaN where nothing was
    p_world: tuple[Float64[ndarray, "h w 3"], ...]  # what every pixel sees
    size: float  # of the object


def make_set(options: SetOptions) -> CoordinateSet:
    """Render one set."""
    scene = make_scene(options.scene, 1.0)
    poses = make_paths(scene, options.frames, options.path, np.random.default_rng([options.seed, 1]))
    devices = make_devices(scene, poses, PATTERN, SynthConfig(resolution=options.resolution))
    projector, poses = _with_shift(devices.projector, poses, scene.vertices[::20], options)
    devices = DevicePair(devices.camera, projector)
    caster, cells = RayCaster(scene), make_cells(np.zeros(PATTERN[::-1], np.float32), None)
    coords, points = [], []
    for k in range(options.frames):
        seen = visible_centres(FrameGeometry(caster, devices, poses.T_world_camera[k], poses.T_world_projector[k]))
        shape = devices.camera.h, devices.camera.w
        exact = np.where(seen.lit[:, None], seen.uv_projector, np.nan).astype(np.float32).reshape(*shape, 2)
        rng = np.random.default_rng([options.seed, 2, k])
        coords.append(disturb_coords(exact, seen.lit.reshape(shape), cells, options.noise, rng))
        points.append(seen.p_world.reshape(*shape, 3))
    return CoordinateSet(devices, poses, tuple(coords), tuple(points), scene.size)


def _with_shift(
    projector: Device, poses: DevicePoses, p_world: Float64[ndarray, "n 3"], options: SetOptions
) -> tuple[Device, DevicePoses]:
    """The projector with lens shift, turned so that its image stays where it was and the object fills 90 % of it."""
    middle = np.array([projector.w / 2, projector.h / 2])
    device = replace(projector, cy=projector.h * (0.5 + options.shift), k1=options.k1)
    for _ in range(10):
        device = replace(device, fl_y=device.fl_x * options.aspect)
        turn = np.eye(4)
        angle = np.arctan2(device.cy - middle[1], device.fl_y)  # from the axis to the middle of the image
        turn[:3, :3] = Rotation.from_euler("x", -angle).as_matrix()
        turned = poses.T_world_projector @ turn
        reach = max(float((np.abs(pixels(device, T, p_world)[0] - middle) / middle).max()) for T in turned)
        if abs(reach - 0.9) < 1e-3:
            break
        device = replace(device, fl_x=device.fl_x * 0.9 / reach)
    return device, replace(poses, T_world_projector=turned)
