"""Reprojection residuals of the corners that a device sees, in all views at once, with their derivatives."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Int64
from numpy import ndarray

from sl_nerfstudio.calibration.board.rig import BoardRig, BoardView, FreeIntrinsics
from sl_nerfstudio.geometry.devices import Device, Intrinsics, project, project_jacobian
from sl_nerfstudio.geometry.devices.models import MODELS
from sl_nerfstudio.geometry.se3 import hat

_BEHIND_PX = 1e4  # the residual of a corner behind a device: a step that turns a board over must not look good


@dataclass(frozen=True)
class Sightings:
    """All corners that one device sees, ordered by view."""

    view: Int64[ndarray, "n"]
    p_board: Float64[ndarray, "n 3"]
    uv: Float64[ndarray, "n 2"]


@dataclass(frozen=True)
class Linearised:
    """Residuals of the corners in one device, and how the predictions change, in pixels."""

    residual: Float64[ndarray, "n 2"]  # seen minus predicted
    by_intrinsics: Float64[ndarray, "n 2 k"]  # for each fitted number
    by_rig: Float64[ndarray, "n 2 6"]  # for a twist (v, w) of T_projector_camera, from the left; 0 in the camera
    by_board: Float64[ndarray, "n 2 6"]  # for a twist of the view's T_camera_board, from the left


def sightings(views: Sequence[BoardView], p_board: Float64[ndarray, "m 3"]) -> tuple[Sightings, ...]:
    """Of the camera, and of the projector if it sees any corner."""
    seen = [[(k, view.camera) for k, view in enumerate(views)],
            [(k, view.projector) for k, view in enumerate(views) if view.projector is not None]]  # fmt: skip
    return tuple(
        Sightings(
            np.concatenate([np.full(len(corners.ids), k) for k, corners in of_device]),
            np.concatenate([p_board[corners.ids] for _, corners in of_device]),
            np.concatenate([corners.uv for _, corners in of_device]),
        )
        for of_device in seen
        if any(len(corners.ids) for _, corners in of_device)
    )


def residuals(rig: BoardRig, device: int, seen: Sightings) -> Float64[ndarray, "n 2"]:
    """Seen minus predicted pixels; `device` is 0 for the camera, 1 for the projector."""
    p = _in_device(rig, device, seen)[1]
    uv, in_front = project(Intrinsics.of(rig.devices[device], torch.float64), torch.from_numpy(p))
    return np.where(in_front.numpy()[:, None], seen.uv - uv.numpy(), _BEHIND_PX)


def linearised(rig: BoardRig, device: int, free: FreeIntrinsics, seen: Sightings) -> Linearised:
    """Residuals with their derivatives."""
    p_camera, p_device = _in_device(rig, device, seen)
    p = torch.from_numpy(p_device)
    intrinsics = Intrinsics.of(rig.devices[device], torch.float64)
    uv, in_front = project(intrinsics, p)
    by_point = project_jacobian(intrinsics, p).numpy()
    R = rig.T_projector_camera[:3, :3] if device else np.eye(3)
    by_board = by_point @ R @ _by_twist(p_camera)
    return Linearised(
        np.where(in_front.numpy()[:, None], seen.uv - uv.numpy(), _BEHIND_PX),
        _by_parameters(rig.devices[device], p) @ free.columns(),
        by_point @ _by_twist(p_device) if device else np.zeros_like(by_board),
        by_board,
    )


def _in_device(rig: BoardRig, device: int, seen: Sightings) -> tuple[Float64[ndarray, "n 3"], Float64[ndarray, "n 3"]]:
    """Corners in the camera's axes, and in the device's."""
    T = rig.T_camera_board[seen.view]
    p_camera = (T[:, :3, :3] @ seen.p_board[..., None])[..., 0] + T[:, :3, 3]
    if not device:
        return p_camera, p_camera
    return p_camera, p_camera @ rig.T_projector_camera[:3, :3].T + rig.T_projector_camera[:3, 3]


def _by_twist(p: Float64[ndarray, "n 3"]) -> Float64[ndarray, "n 3 6"]:
    """d(exp(v, w) p) / d(v, w) at 0."""
    eye = np.broadcast_to(np.eye(3), (len(p), 3, 3))
    return np.concatenate([eye, -hat(torch.from_numpy(p)).numpy()], -1)


def _by_parameters(device: Device, p: torch.Tensor) -> Float64[ndarray, "n 2 8"]:
    """Derivatives of pixels by PARAMETERS."""
    x, y, _, _ = (t.numpy() for t in MODELS[device.model].jacobian(p))
    r2 = x * x + y * y
    o, one = np.zeros_like(x), np.ones_like(x)
    radial = 1 + r2 * (device.k1 + r2 * device.k2)
    xd = x * radial + 2 * device.p1 * x * y + device.p2 * (r2 + 2 * x * x)
    yd = y * radial + device.p1 * (r2 + 2 * y * y) + 2 * device.p2 * x * y
    lens_x = np.stack([x * r2, x * r2 * r2, 2 * x * y, r2 + 2 * x * x], -1) * device.fl_x
    lens_y = np.stack([y * r2, y * r2 * r2, r2 + 2 * y * y, 2 * x * y], -1) * device.fl_y
    u = np.concatenate([np.stack([xd, o, one, o], -1), lens_x], -1)
    v = np.concatenate([np.stack([o, yd, o, one], -1), lens_y], -1)
    return np.stack([u, v], 1)
