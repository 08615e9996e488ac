"""Bundle adjustment of both devices and all boards: Levenberg-Marquardt with a robust kernel.

Corners in the camera and in the projector have noise of different size, which is estimated from the residuals. Boards
are eliminated from the normal equations (Schur complement), so many of them cost little.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.calibration.board.residuals import Sightings, linearised, residuals
from sl_nerfstudio.calibration.board.rig import BoardRig, FreeIntrinsics, with_numbers
from sl_nerfstudio.geometry.robust import MAD_TO_SIGMA, geman_mcclure_cost, geman_mcclure_weight
from sl_nerfstudio.geometry.se3 import exp_se3

_KERNEL = 4.0  # standard deviations at which a corner's weight is a quarter (Geman-McClure)
_LEAST_SIGMA = 1e-6  # pixels: noise-free corners
_ROUNDS = 4  # of estimating the noise
_SETTLED = 0.02  # relative change of the noise
_MOST_STEPS = 50
_CONVERGED = 1e-6  # relative decrease of the cost
_LEAST_DAMPING, _FIRST_DAMPING, _LARGEST_DAMPING = 1e-12, 1e-5, 1e10
_PLACING_STEPS = 4
_SINGULAR = 1e-14  # of the largest eigenvalue, with all numbers scaled alike

Free = tuple[FreeIntrinsics, ...]
"""Of the camera, and of the projector if there is one."""
Seen = tuple[Sightings, ...]
Sigma = tuple[float, ...]


@dataclass(frozen=True)
class Adjusted:
    """The solution, its noise, and the normal equations without the boards."""

    rig: BoardRig
    free: Free
    sigma_px: Sigma  # of a coordinate of a corner in each device
    information: Float64[ndarray, "s s"]  # of the fitted intrinsics of each device, then of the rig's twist


@dataclass(frozen=True)
class Normal:
    """Normal equations: shared numbers, and those of each board with what couples them to the shared ones."""

    cost: float
    H: Float64[ndarray, "s s"]
    g: Float64[ndarray, "s"]
    H_board: Float64[ndarray, "b 6 6"]
    coupling: Float64[ndarray, "b s 6"]
    g_board: Float64[ndarray, "b 6"]

    def reduced(self, damping: float) -> tuple[Float64[ndarray, "s s"], Float64[ndarray, "s"]]:
        """Without the boards."""
        solved = np.linalg.solve(
            self._damped(damping), np.concatenate([self.coupling.transpose(0, 2, 1), self.g_board[..., None]], -1)
        )
        H = self.H + damping * np.diag(np.diag(self.H)) - np.einsum("bsk,bkt->st", self.coupling, solved[..., :-1])
        return H, self.g - np.einsum("bsk,bk->s", self.coupling, solved[..., -1])

    def step(self, damping: float) -> tuple[Float64[ndarray, "s"], Float64[ndarray, "b 6"]]:
        """Of the shared numbers, and of the boards."""
        H, g = self.reduced(damping)
        scale = 1 / np.sqrt(np.diag(self.H).clip(1e-300))
        shared = scale * np.linalg.lstsq(H * scale[:, None] * scale, g * scale, rcond=_SINGULAR)[0]
        rest = self.g_board - np.einsum("bsk,s->bk", self.coupling, shared)
        return shared, np.linalg.solve(self._damped(damping), rest[..., None])[..., 0]

    def _damped(self, damping: float) -> Float64[ndarray, "b 6 6"]:
        diagonal = np.diagonal(self.H_board, axis1=1, axis2=2)
        least = _SINGULAR * diagonal.max(1, keepdims=True).clip(1e-300)
        return self.H_board + (damping * diagonal + least)[..., None] * np.eye(6)


def adjust(start: BoardRig, free: Free, seen: Seen, sigma_px: Sigma | None = None) -> Adjusted:
    """The rig that explains the corners best. `sigma_px` holds the noise fixed; default: it is estimated."""
    rig = start
    sigma = sigma_px or noise(rig, free, seen)
    for _ in range(1 if sigma_px else _ROUNDS):
        rig, normal = _minimised(rig, free, seen, sigma)
        before, sigma = sigma, sigma_px or noise(rig, free, seen)
        if np.allclose(before, sigma, rtol=_SETTLED):
            break
    return Adjusted(rig, free, sigma, normal.reduced(0.0)[0])


def covariance(information: Float64[ndarray, "s s"]) -> Float64[ndarray, "s s"]:
    """Of the fitted numbers, by the noise of the corners alone; huge where they do not determine them."""
    scale = 1 / np.sqrt(np.diag(information).clip(1e-300))
    values, vectors = np.linalg.eigh(information * scale[:, None] * scale)
    inverse = (vectors / values.clip(_SINGULAR * values.max())) @ vectors.T
    return inverse * scale[:, None] * scale


def place_boards(rig: BoardRig, seen: Sightings, sigma_px: float) -> BoardRig:
    """Every board where its corners in the camera put it; the rest of the rig stays."""
    for _ in range(_PLACING_STEPS):
        one = linearised(rig, 0, FreeIntrinsics(), seen)
        root = np.sqrt(kernel(one.residual / sigma_px)[1])[:, None]
        steps = np.zeros((len(rig.T_camera_board), 6))
        for b in range(len(steps)):
            own = seen.view == b
            B, e = (one.by_board * root[..., None])[own].reshape(-1, 6), (one.residual * root)[own].ravel()
            steps[b] = np.linalg.lstsq(B, e, rcond=_SINGULAR)[0]
        rig = replace(rig, T_camera_board=_exp(steps) @ rig.T_camera_board)
    return rig


def noise(rig: BoardRig, free: Free, seen: Seen) -> Sigma:
    """Robust standard deviation of a coordinate in each device, with the degrees of freedom of the whole fit."""
    fitted = sum(one.columns().shape[1] for one in free) + 6 * (len(free) - 1 + len(rig.T_camera_board))
    total = 2 * sum(len(one.view) for one in seen)
    freedom = np.sqrt(max(total - fitted, 1) / total)
    medians = [float(np.median(np.abs(residuals(rig, k, one)))) for k, one in enumerate(seen)]
    return tuple(max(MAD_TO_SIGMA * median / freedom, _LEAST_SIGMA) for median in medians)


def _minimised(rig: BoardRig, free: Free, seen: Seen, sigma: Sigma) -> tuple[BoardRig, Normal]:
    normal, damping = normal_equations(rig, free, seen, sigma), _FIRST_DAMPING
    for _ in range(_MOST_STEPS):
        moved = _moved(rig, free, *normal.step(damping))
        cost = _cost(moved, seen, sigma)
        if cost < normal.cost:
            decrease = (normal.cost - cost) / normal.cost
            rig, damping = moved, max(damping / 10, _LEAST_DAMPING)
            normal = normal_equations(rig, free, seen, sigma)
            if decrease < _CONVERGED:
                break
        else:
            damping *= 10
            if damping > _LARGEST_DAMPING:
                break
    return rig, normal


def _cost(rig: BoardRig, seen: Seen, sigma: Sigma) -> float:
    return sum(
        float(kernel(residuals(rig, k, one) / s)[0].sum()) for k, (one, s) in enumerate(zip(seen, sigma, strict=True))
    )


def kernel(whitened: Float64[ndarray, "n 2"]) -> tuple[Float64[ndarray, "n"], Float64[ndarray, "n"]]:
    """Geman-McClure cost of corners, and their weights, from residuals in standard deviations."""
    x = (whitened**2).sum(-1) / _KERNEL**2
    return _KERNEL**2 * geman_mcclure_cost(x), geman_mcclure_weight(x)


def normal_equations(rig: BoardRig, free: Free, seen: Seen, sigma: Sigma) -> Normal:
    """Of all corners at a rig."""
    begin = np.cumsum([0, *(one.columns().shape[1] for one in free)])
    size, boards = int(begin[-1]) + (6 if len(free) == 2 else 0), len(rig.T_camera_board)
    products, cost = np.zeros((boards, size + 7, size + 7)), 0.0  # of all columns: shared, of the board, residual
    for k, of_device in enumerate(seen):
        one = linearised(rig, k, free[k], of_device)
        costs, weights = kernel(one.residual / sigma[k])
        cost += float(costs.sum())
        rows = np.zeros((len(weights), 2, size + 7))
        rows[..., begin[k] : begin[k + 1]] = one.by_intrinsics
        if k:
            rows[..., size - 6 : size] = one.by_rig
        rows[..., size : size + 6] = one.by_board
        rows[..., -1] = one.residual
        rows *= (np.sqrt(weights) / sigma[k])[:, None, None]
        ends = np.searchsorted(of_device.view, np.arange(boards + 1))  # corners are ordered by view
        for b in range(boards):
            own = rows[ends[b] : ends[b + 1]].reshape(-1, size + 7)
            products[b] += own.T @ own
    of_boards = slice(size, size + 6)
    return Normal(
        cost,
        products[:, :size, :size].sum(0),
        products[:, :size, -1].sum(0),
        products[:, of_boards, of_boards],
        products[:, :size, of_boards],
        products[:, of_boards, -1],
    )


def _moved(rig: BoardRig, free: Free, shared: Float64[ndarray, "s"], boards: Float64[ndarray, "b 6"]) -> BoardRig:
    devices, place = [], 0
    for device, one in zip(rig.devices, free, strict=True):
        columns = one.columns()
        devices.append(with_numbers(device, device.parameters + columns @ shared[place : place + columns.shape[1]]))
        place += columns.shape[1]
    T_projector_camera = rig.T_projector_camera
    if len(free) == 2:
        T_projector_camera = _exp(shared[None, -6:])[0] @ T_projector_camera
    T_camera_board = _exp(boards) @ rig.T_camera_board
    return replace(rig.with_devices(devices), T_camera_board=T_camera_board, T_projector_camera=T_projector_camera)


def _exp(twists: Float64[ndarray, "n 6"]) -> Float64[ndarray, "n 4 4"]:
    return exp_se3(torch.from_numpy(twists)).numpy()
