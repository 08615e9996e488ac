"""Intrinsics that suit a scene: the object fills the image, the pattern covers the object."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device, DeviceKind, Intrinsics, project, unproject
from sl_nerfstudio.synthesis.paths import DISTANCE
from sl_nerfstudio.synthesis.scene import Scene

Distortion = tuple[float, float, float, float]
_CAMERA_FILL = 0.84  # of the image's half width: radius of the object
_PATTERN_FILL = 0.80


@dataclass(frozen=True)
class Pair:
    """The camera and the projector of a scan."""

    camera: Device
    projector: Device


def make_devices(
    scene: Scene,
    resolution: int,
    pattern_size: tuple[int, int],
    projector_model: DeviceKind = "OPENCV",
    camera_distortion: Distortion = (0.0, 0.0, 0.0, 0.0),
    projector_distortion: Distortion = (0.0, 0.0, 0.0, 0.0),
) -> Pair:
    """A square camera of `resolution` pixels and a projector of the pattern's (w, h)."""
    spread = DISTANCE * scene.size / scene.radius
    fl = _CAMERA_FILL * resolution / 2 * spread
    w, h = pattern_size
    fl_p = _PATTERN_FILL * min(w, h) / 2 * spread
    # principal points a little off the middle, as real devices have them
    camera = Device(
        resolution, resolution, fl, fl, 0.503 * resolution, 0.496 * resolution, *camera_distortion, model="OPENCV"
    )
    projector = Device(w, h, fl_p, fl_p, 0.498 * w, 0.505 * h, *projector_distortion, model=projector_model)
    return Pair(camera, projector)


def rays(
    device: Device, T_world_device: Float[ndarray, "4 4"], uv: Float[ndarray, "n 2"]
) -> Float64[ndarray, "n 3"]:
    """Unit directions in the world of the rays through pixels."""
    directions = unproject(Intrinsics.of(device, torch.float64), torch.from_numpy(np.ascontiguousarray(uv, np.float64)))
    return directions.numpy() @ T_world_device[:3, :3].T


def pixels(
    device: Device, T_world_device: Float[ndarray, "4 4"], p_world: Float[ndarray, "n 3"]
) -> tuple[Float64[ndarray, "n 2"], Bool[ndarray, "n"]]:
    """Pixels of points in the world, and whether each lies in front of the device and inside its image."""
    p_device = (p_world - T_world_device[:3, 3]) @ T_world_device[:3, :3]
    uv, in_front = project(Intrinsics.of(device, torch.float64), torch.from_numpy(p_device))
    x, y = uv.numpy().T
    inside = in_front.numpy() & (x >= 0) & (y >= 0) & (x < device.w) & (y < device.h)
    return uv.numpy(), inside
