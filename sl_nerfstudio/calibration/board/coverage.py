"""How varied the views are, and which further pose of the board would help most."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import torch
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.calibration.board.adjustment import Adjusted, normal_equations
from sl_nerfstudio.calibration.board.detection import Corners
from sl_nerfstudio.calibration.board.residuals import sightings
from sl_nerfstudio.calibration.board.rig import BoardRig, BoardView
from sl_nerfstudio.calibration.board.uncertainty import formal_sigmas
from sl_nerfstudio.geometry.devices import Device, Intrinsics, project, unproject

_GRID = (8, 6)  # cells of the image that corners are counted in
_TILTS = {"facing the camera": (0.0, 0.0), "left edge nearer": (0.0, 35.0), "right edge nearer": (0.0, -35.0),
          "top edge nearer": (35.0, 0.0), "bottom edge nearer": (-35.0, 0.0)}  # fmt: skip
_PLACES = {"left": 0.25, "middle": 0.5, "right": 0.75}
_HEIGHTS = {"upper": 0.25, "middle": 0.5, "lower": 0.75}
_NEARER = (0.7, 1.0, 1.4)  # distances tried, relative to the usual one
_DISTANCES = ("nearer than usual", "at the usual distance", "farther than usual")
_LEAST_SEEN = 0.5  # of the corners of a suggested board that must be in both devices' images


@dataclass(frozen=True)
class Coverage:
    """How varied the views are."""

    tilt_deg: float  # largest angle between two boards
    depth_ratio: float  # distance of the farthest board over that of the nearest
    camera: float  # share of the cells of the image that hold a corner
    projector: float | None  # the same for the pattern; None without a projector


@dataclass(frozen=True)
class NextPose:
    """The further view that makes the focal lengths and principal points most certain."""

    tilt: str
    column: str  # of the image
    row: str
    distance: str
    sigma_after: float  # the largest relative standard deviation of a focal length with it, by the corners' noise
    sigma_before: float


def coverage_of(adjusted: Adjusted, views: Sequence[BoardView]) -> Coverage:
    """How varied the views are."""
    rig = adjusted.rig
    normals, distance = rig.T_camera_board[:, :3, 2], np.linalg.norm(rig.T_camera_board[:, :3, 3], axis=1)
    tilt = np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1).min()))
    in_pattern = [view.projector for view in views if view.projector is not None]
    return Coverage(
        float(tilt),
        float(distance.max() / distance.min()),
        _filled([view.camera for view in views], rig.camera),
        None if rig.projector is None else _filled(in_pattern, rig.projector),
    )


def _filled(corners: Sequence[Corners], device: Device) -> float:
    """Share of the cells of a device's image that hold a corner."""
    uv = np.concatenate([one.uv for one in corners]) if corners else np.zeros((0, 2))
    column, row = (np.clip(uv / (device.w, device.h), 0, 1 - 1e-9) * _GRID).astype(int).T
    filled = np.zeros(_GRID[::-1], dtype=bool)
    filled[row, column] = True
    return float(filled.mean())


def next_pose(adjusted: Adjusted, p_board: Float64[ndarray, "m 3"]) -> NextPose | None:
    """Tried out on boards in many places: what the corners of each would add. None if no board fits the images."""
    best: tuple[float, NextPose] | None = None
    before = _relative_sigma(adjusted, adjusted.information)
    for words, T in _boards(adjusted.rig, p_board):
        information = _added(adjusted, T, p_board)
        if information is None:
            continue
        score, focal = _relative_sigma(adjusted, adjusted.information + information)
        if best is None or score < best[0]:
            best = (score, NextPose(*words, focal, before[1]))
    return None if best is None else best[1]


def _boards(rig: BoardRig, p_board: Float64[ndarray, "m 3"]) -> Iterator[tuple[tuple[str, str, str, str], ndarray]]:
    """Tilted boards all over the image, turned upright, with the middle of the corners at the place."""
    middle = p_board.mean(0)
    points = rig.T_camera_board[:, :3, :3] @ middle + rig.T_camera_board[:, :3, 3]
    usual = float(np.median(np.linalg.norm(points, axis=1)))
    choices = product(_TILTS.items(), _PLACES.items(), _HEIGHTS.items(), zip(_DISTANCES, _NEARER, strict=True))
    intrinsics = Intrinsics.of(rig.camera, torch.float64)
    for (tilt, angles), (column, x), (row, y), (far, factor) in choices:
        uv = torch.tensor([x * rig.camera.w, y * rig.camera.h], dtype=torch.float64)
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("xy", angles, degrees=True).as_matrix()
        T[:3, 3] = unproject(intrinsics, uv).numpy() * usual * factor - T[:3, :3] @ middle
        yield (tilt, column, row, far), T


def _added(adjusted: Adjusted, T: ndarray, p_board: Float64[ndarray, "m 3"]) -> Float64[ndarray, "s s"] | None:
    """Information on the shared numbers from one board; None if too little of it is in the images."""
    rig = replace(adjusted.rig, T_camera_board=T[None])
    seen = []
    for k, device in enumerate(rig.devices):
        T_device_board = rig.T_projector_camera @ T if k else T
        p = torch.from_numpy(p_board @ T_device_board[:3, :3].T + T_device_board[:3, 3])
        uv, in_front = project(Intrinsics.of(device, torch.float64), p)
        inside = (in_front.numpy() & (uv.numpy() > 0).all(1) & (uv.numpy() < (device.w, device.h)).all(1)).nonzero()[0]
        if len(inside) < _LEAST_SEEN * len(p_board):
            return None
        seen.append(Corners(inside, uv.numpy()[inside]))
    view = BoardView("", seen[0], seen[1] if len(seen) > 1 else None)
    return normal_equations(rig, adjusted.free, sightings([view], p_board), adjusted.sigma_px).reduced(0.0)[0]


def _relative_sigma(adjusted: Adjusted, information: Float64[ndarray, "s s"]) -> tuple[float, float]:
    """Of focal length and principal point together, the worse device; and of the focal length alone."""
    sigmas = formal_sigmas(adjusted.free, information)
    relative = [s[:4] / device.fl_x for s, device in zip(sigmas, adjusted.rig.devices, strict=True)]
    return max(float(np.linalg.norm(s)) for s in relative), max(float(s[:2].max()) for s in relative)
