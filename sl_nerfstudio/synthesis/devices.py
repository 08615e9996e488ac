"""Intrinsics that fit a scene: the object fills the image, and the pattern covers the object."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from numpy import ndarray

from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.devices import Device, DeviceKind, Intrinsics, project, unproject
from sl_nerfstudio.synthesis.scenes.scene import Scene

Distortion = tuple[float, float, float, float]
_CAMERA_FILL = 0.92  # of half the image, reached by the object in the frame where it extends farthest
_PATTERN_FILL = 0.88


@dataclass(frozen=True)
class DevicePair:
    """The camera and the projector of a scan."""

    camera: Device
    projector: Device


@dataclass(frozen=True)
class DeviceOptions:
    """The options for both devices."""

    resolution: int = 400
    projector_model: DeviceKind = "OPENCV"
    camera_distortion: Distortion = (0.0, 0.0, 0.0, 0.0)
    projector_distortion: Distortion = (0.0, 0.0, 0.0, 0.0)


def make_devices(scene: Scene, poses: DevicePoses, pattern_size: tuple[int, int], options: DeviceOptions) -> DevicePair:
    """A square camera and a projector of the pattern's (w, h), zoomed so that the whole object is in every frame."""
    n, (w, h) = options.resolution, pattern_size
    # principal points slightly off the middle, as in real devices
    camera = Device(n, n, 1.0, 1.0, 0.503 * n, 0.496 * n, *options.camera_distortion)
    projector = Device(w, h, 1.0, 1.0, 0.498 * w, 0.505 * h, *options.projector_distortion, options.projector_model)
    return DevicePair(
        _zoomed(camera, scene, poses.T_world_camera, _CAMERA_FILL),
        _zoomed(projector, scene, poses.T_world_projector, _PATTERN_FILL),
    )


def _zoomed(device: Device, scene: Scene, T_world_device: Float[ndarray, "n 4 4"], fill: float) -> Device:
    """The device with the focal length at which the object extends to `fill` of half the image."""
    some = scene.vertices[:: max(1, len(scene.vertices) // 2000)]
    reach = 0.0
    for T in T_world_device:
        out = np.abs(pixels(device, T, some)[0] - (device.cx, device.cy)) / (device.w / 2, device.h / 2)
        reach = max(reach, float(out.max()))
    return replace(device, fl_x=fill / reach, fl_y=fill / reach)


def rays(device: Device, T_world_device: Float[ndarray, "4 4"], uv: Float[ndarray, "n 2"]) -> Float64[ndarray, "n 3"]:
    """Unit directions in the world of the rays through pixels."""
    directions = unproject(Intrinsics.of(device, torch.float64), torch.from_numpy(np.ascontiguousarray(uv, np.float64)))
    return directions.numpy() @ T_world_device[:3, :3].T


def pixels(
    device: Device, T_world_device: Float[ndarray, "4 4"], p_world: Float[ndarray, "n 3"]
) -> tuple[Float64[ndarray, "n 2"], Bool[ndarray, "n"]]:
    """Pixels of points in the world, and whether each is in front of the device and inside its image."""
    p_device = (p_world - T_world_device[:3, 3]) @ T_world_device[:3, :3]
    uv, in_front = project(Intrinsics.of(device, torch.float64), torch.from_numpy(p_device))
    x, y = uv.numpy().T
    inside = in_front.numpy() & (x >= 0) & (y >= 0) & (x < device.w) & (y < device.h)
    return uv.numpy(), inside
