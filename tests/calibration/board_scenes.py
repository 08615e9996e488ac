"""Corners of a board in both devices, computed from known devices and poses, without images."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.calibration.board_adjustment import BoardRig, BoardView, Corners, board_points, sightings
from sl_nerfstudio.geometry.devices import Device, Intrinsics, project, unproject
from sl_nerfstudio.pattern.boards import Chessboard

BOARD = Chessboard(7, 5, 30.0)
POINTS = board_points(BOARD.corners())
CAMERA = Device(1280, 960, 1500.0, 1500.0, 652.0, 470.0, -0.1, 0.05)
PLAIN_CAMERA = Device(1280, 960, 1500.0, 1500.0, 652.0, 470.0)
PROJECTOR = Device(1280, 800, 1700.0, 1700.0, 630.0, 960.0, -0.05)  # centre 1.2 heights below the upper edge
PLAIN_PROJECTOR = Device(1280, 800, 1700.0, 1700.0, 630.0, 960.0)
DOE = Device(800, 800, 900.0, 900.0, 405.0, 390.0, model="DOE")


@dataclass(frozen=True)
class Scene:
    """Views, and the rig that they were made from."""

    views: list[BoardView]
    truth: BoardRig

    @property
    def seen(self):
        """All corners of each device."""
        return sightings(self.views, POINTS)

    @property
    def sizes(self):
        """(w, h) of the camera and of the projector."""
        return [(device.w, device.h) for device in self.truth.devices]


def make_scene(
    seed: int = 0, count: int = 8, noise: float = 0.0, camera: Device = CAMERA, projector: Device | None = PROJECTOR,
    spread: float = 35.0, depths: tuple[float, float] = (600.0, 1000.0),
) -> Scene:  # fmt: skip
    """Boards turned by up to `spread` degrees, all of them whole in the camera and half or more in the pattern."""
    rng = np.random.default_rng(seed)
    T_pc = np.eye(4) if projector is None else _relative_pose(projector, sum(depths) / 2)
    views, poses = [], []
    for _ in range(1000):
        if len(views) == count:
            break
        T = _board_pose(rng, spread, depths, (0.25, 0.2))
        whole = _corners(camera, T)
        lit = None if projector is None else _corners(projector, T_pc @ T)
        if len(whole.ids) < len(POINTS) or (lit is not None and 2 * len(lit.ids) < len(POINTS)):
            continue
        views.append(BoardView(f"pose {len(views)}", _noisy(whole, noise, rng), lit and _noisy(lit, noise, rng)))
        poses.append(T)
    assert len(views) == count
    return Scene(views, BoardRig(camera, projector, np.array(poses), T_pc))


def equidistant_scene(seed: int, count: int, noise: float) -> Scene:
    """Boards all over the image of a lens with r = f theta, seen whole or in part; the truth holds size and poses."""
    rng = np.random.default_rng(seed)
    camera, views, poses = Device(1280, 960, 815.0, 815.0, 652.0, 470.0), [], []
    while len(views) < count:
        T = _board_pose(rng, 40.0, (250.0, 500.0), (0.75, 0.55))
        x, y, depth = ((POINTS @ T[:3, :3].T + T[:3, 3]) * [1, -1, -1]).T
        radius = np.hypot(x, y)
        uv = (camera.cx, camera.cy) + (camera.fl_x * np.arctan2(radius, depth) / radius)[:, None] * np.c_[x, y]
        inside = (depth > 50) & (uv > 0).all(1) & (uv < (camera.w, camera.h)).all(1)
        if 2 * inside.sum() > len(POINTS):
            corners = Corners(np.flatnonzero(inside), uv[inside])
            views.append(BoardView(f"pose {len(views)}", _noisy(corners, noise, rng), None))
            poses.append(T)
    return Scene(views, BoardRig(camera, None, np.array(poses), np.eye(4)))


def _board_pose(
    rng: np.random.Generator, spread: float, depths: tuple[float, float], sides: tuple[float, float]
) -> ndarray:
    """A board turned by up to `spread` degrees; its middle lies up to `sides` of its depth beside the axis."""
    T = np.eye(4)
    angles = [*rng.uniform(-spread, spread, 2), rng.uniform(-20, 20)]
    T[:3, :3] = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    z = rng.uniform(*depths)
    T[:3, 3] = [*(rng.uniform(-side, side) * z for side in sides), -z] - T[:3, :3] @ POINTS.mean(0)
    return T


def _relative_pose(projector: Device, distance: float) -> ndarray:
    """The middle of the pattern falls on the middle of the camera's view."""
    T_cp = np.eye(4)
    T_cp[:3, 3] = [0.25 * distance, 0.05 * distance, 10.0]
    middle = torch.tensor([projector.w / 2, projector.h / 2], dtype=torch.float64)
    ray = unproject(Intrinsics.of(projector, torch.float64), middle).numpy()
    towards = np.array([0, 0, -distance]) - T_cp[:3, 3]
    turn = Rotation.align_vectors([towards / np.linalg.norm(towards), [0, 1, 0]], [ray, [0, 1, 0]], [1e6, 1])[0]
    T_cp[:3, :3] = turn.as_matrix()
    return np.linalg.inv(T_cp)


def _corners(device: Device, T_device_board: ndarray) -> Corners:
    p = torch.from_numpy(POINTS @ T_device_board[:3, :3].T + T_device_board[:3, 3])
    uv, in_front = project(Intrinsics.of(device, torch.float64), p)
    inside = in_front.numpy() & (uv.numpy() > 0).all(1) & (uv.numpy() < (device.w, device.h)).all(1)
    return Corners(np.flatnonzero(inside), uv.numpy()[inside])


def _noisy(corners: Corners, noise: float, rng: np.random.Generator) -> Corners:
    return Corners(corners.ids, corners.uv + noise * rng.standard_normal(corners.uv.shape))
