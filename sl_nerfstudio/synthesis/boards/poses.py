"""Devices and poses of a board: tilted, near and far, all over the image, and lit by the whole projector."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project, unproject
from sl_nerfstudio.pattern.boards import Board
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.devices import DevicePair

_FOCAL = 1.3  # in widths of the image: a field of view of 42 degrees
_PROJECTOR_FOCAL = 1.4
_LENS_SHIFT = 1.2  # principal point of the projector, in heights of the pattern from its upper edge
_BASELINE = 0.35  # in distances of the board
_LARGEST_TILT_DEG = 40.0
_NEAREST, _FARTHEST = 0.75, 1.25  # in usual distances
_FILL = 0.45  # of the image's width, at the usual distance
_TRIES = 10_000


@dataclass(frozen=True)
class BoardScene:
    """Both devices, and the board in every pose; boards have x to the right, y up, and z = 0, in millimetres."""

    board: Board
    camera: Device
    projector: Device
    T_projector_camera: Float64[ndarray, "4 4"]
    T_camera_board: Float64[ndarray, "n 4 4"]


def board_devices(pattern: tuple[int, int], config: SynthConfig) -> DevicePair:
    """A camera of 4:3, and a projector whose principal point lies below its image; `pattern` is its (w, h)."""
    w, h = config.resolution, round(0.75 * config.resolution)
    f = _FOCAL * w
    camera = Device(w, h, f, f, 0.51 * w, 0.49 * h, *config.camera_distortion)
    columns, rows = pattern
    fp = _PROJECTOR_FOCAL * columns
    projector = Device(columns, rows, fp, fp, 0.49 * columns, _LENS_SHIFT * rows, *config.projector_distortion,
                       config.projector_model)  # fmt: skip
    return DevicePair(camera, projector)


def make_board_scene(board: Board, devices: DevicePair, poses: int, rng: np.random.Generator) -> BoardScene:
    """Poses with all corners in the camera's image and in the pattern."""
    camera, projector = devices.camera, devices.projector
    p_board = np.c_[board.corners() * (1, -1), np.zeros(len(board.corners()))]
    distance = camera.fl_x / camera.w / _FILL * float(np.ptp(p_board[:, 0]))
    T_projector_camera = _relative_pose(projector, distance)
    found: list[ndarray] = []
    for _ in range(_TRIES):
        T = _random_pose(camera, p_board, distance, rng)
        if _inside(camera, T, p_board).all() and _inside(projector, T_projector_camera @ T, p_board).all():
            found.append(T)
            if len(found) == poses:
                return BoardScene(board, camera, projector, T_projector_camera, np.array(found))
    raise AssertionError("the devices see no common volume")


def _relative_pose(projector: Device, distance: float) -> Float64[ndarray, "4 4"]:
    """The middle of the pattern falls on the point at which the camera looks from the usual distance."""
    target = np.array([0.0, 0.0, -distance])
    T_camera_projector = np.eye(4)
    T_camera_projector[:3, 3] = distance * _BASELINE * np.array([np.cos(0.2), np.sin(0.2), 0.1])
    towards = target - T_camera_projector[:3, 3]
    middle = torch.tensor([projector.w / 2, projector.h / 2], dtype=torch.float64)
    ray = unproject(Intrinsics.of(projector, torch.float64), middle).numpy()
    R, _ = Rotation.align_vectors(
        [towards / np.linalg.norm(towards), [0.0, 1.0, 0.0]], [ray, [0.0, 1.0, 0.0]], [1e6, 1.0]
    )
    T_camera_projector[:3, :3] = R.as_matrix()
    return np.linalg.inv(T_camera_projector)


def _random_pose(
    camera: Device, p_board: Float64[ndarray, "n 3"], distance: float, rng: np.random.Generator
) -> Float64[ndarray, "4 4"]:
    tilt = rng.uniform(-_LARGEST_TILT_DEG, _LARGEST_TILT_DEG, 2)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", [*tilt, rng.uniform(-20, 20)], degrees=True).as_matrix()
    uv = torch.from_numpy(rng.uniform(0.2, 0.8, 2) * (camera.w, camera.h))
    ray = unproject(Intrinsics.of(camera, torch.float64), uv).numpy()
    T[:3, 3] = ray * distance * rng.uniform(_NEAREST, _FARTHEST) - T[:3, :3] @ p_board.mean(0)
    return T


def _inside(device: Device, T_device_board: ndarray, p_board: Float64[ndarray, "n 3"]) -> Bool[ndarray, "n"]:
    p = p_board @ T_device_board[:3, :3].T + T_device_board[:3, 3]
    uv, in_front = project(Intrinsics.of(device, torch.float64), torch.from_numpy(p))
    x, y = uv.numpy().T
    margin = 0.03 * min(device.w, device.h)
    return in_front.numpy() & (x > margin) & (y > margin) & (x < device.w - margin) & (y < device.h - margin)
