"""Bundle adjustment of a camera, a projector and the boards that they see: a first solution, and the best one.

The start is Zhang's, "A flexible new technique for camera calibration" (PAMI 2000); several focal lengths are tried
besides the one in closed form, which noise can make imaginary. Corners in the camera and in the projector have noise of
different size, which is estimated from the residuals. Boards are eliminated from the normal equations, so many of them
cost little.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np
import torch
from jaxtyping import Float64, Int64
from numpy import ndarray

from sl_nerfstudio.calibration.formats import lens_slopes
from sl_nerfstudio.geometry.devices import (
    MODELS,
    PARAMETERS,
    Y_Z_DOWN,
    Device,
    DeviceKind,
    Intrinsics,
    distort,
    project,
    project_jacobian,
)
from sl_nerfstudio.geometry.least_squares import BlockEquations, minimise
from sl_nerfstudio.geometry.lie import exp_se3, hat
from sl_nerfstudio.geometry.numerics import MAD_TO_SIGMA, geman_mcclure_cost, geman_mcclure_weight

_BEHIND_PX = 1e4  # the residual of a corner behind a device: a step that turns a board over must not look good
_KERNEL = 4.0  # standard deviations at which a corner's weight is a quarter (Geman-McClure)
_LEAST_SIGMA = 1e-6  # pixels: noise-free corners
_ROUNDS, _SETTLED = 4, 0.02  # of estimating the noise, and its relative change in the last one
_TOLERANCE, _FIRST_DAMPING = 1e-6, 1e-5  # share of the cost that may be left to gain
_PLACING_STEPS = 4
_SINGULAR = 1e-14  # of the largest eigenvalue, with all numbers scaled alike
_FOCAL_LENGTHS = (0.6, 1.0, 1.6, 2.5, 4.0)  # in widths of the image
_ASPECTS = (1.0, 0.5, 0.7, 1.4, 2.0)  # fl_y over fl_x: pixels need not be square
_SQUARE = 2.0  # noise with square pixels, relative to that with two focal lengths: up to here they are taken as square
_CENTRES = (0.5, 1.0, 0.0, 1.3, -0.3)  # principal point of a projector, in heights of the pattern: lens shift
_TRIED = 3  # of the starts that fit best, how many are adjusted
_LEAST_CORNERS = 6
Size = tuple[int, int]


@dataclass(frozen=True)
class Corners:
    """Corners of a board in the image of a device."""

    ids: Int64[ndarray, "n"]  # places in `board.corners()`, ascending
    uv: Float64[ndarray, "n 2"]  # pixels; the centre of the first pixel is (0.5, 0.5)


@dataclass(frozen=True)
class BoardView:
    """One pose of the board, as both devices see it."""

    name: str
    camera: Corners
    projector: Corners | None  # in pattern pixels; None where no pattern was projected, or too little of it decoded


@dataclass(frozen=True)
class FreeIntrinsics:
    """Which intrinsics of a device are fitted. Focal length and principal point always are."""

    aspect: bool = False  # fl_x and fl_y apart
    terms: int = 0  # of the lens distortion: the first 0, 1, 2 or 4 of k1, k2, p1, p2

    def columns(self) -> Float64[ndarray, "8 n"]:
        """How PARAMETERS change with each fitted number, the first of which is fl_x or the common focal length."""
        unit = np.eye(8)
        focal = [unit[0], unit[1]] if self.aspect else [unit[0] + unit[1]]
        return np.stack([*focal, unit[2], unit[3], *unit[4 : 4 + self.terms]], -1)

    def __str__(self) -> str:
        """Name the free numbers."""
        lens = ("no lens distortion", "k1", "k1, k2", "", "k1, k2, p1, p2")[self.terms]
        return f"{'two focal lengths' if self.aspect else 'one focal length'}, {lens}"


@dataclass(frozen=True)
class BoardRig:
    """A solution. Boards lie in the plane z = 0 of their frame, x to the right and y up, in the board's unit."""

    camera: Device
    projector: Device | None
    T_camera_board: Float64[ndarray, "n 4 4"]  # of every view
    T_projector_camera: Float64[ndarray, "4 4"]

    @property
    def devices(self) -> tuple[Device, ...]:
        """The camera, and the projector if there is one."""
        return (self.camera,) if self.projector is None else (self.camera, self.projector)

    def only(self, views: Sequence[int]) -> "BoardRig":
        """The rig with the boards of some views."""
        return replace(self, T_camera_board=self.T_camera_board[list(views)])


def board_points(corners: Float64[ndarray, "n 2"]) -> Float64[ndarray, "n 3"]:
    """`board.corners()`, which have y down, as points of the board's frame."""
    return np.c_[corners[:, 0], -corners[:, 1], np.zeros(len(corners))]


@dataclass(frozen=True)
class CornerSightings:
    """All corners that one device sees, ordered by view."""

    view: Int64[ndarray, "n"]
    p_board: Float64[ndarray, "n 3"]
    uv: Float64[ndarray, "n 2"]


def sightings(views: Sequence[BoardView], p_board: Float64[ndarray, "m 3"]) -> tuple[CornerSightings, ...]:
    """The corners that the camera sees, and those of the projector if it sees any."""
    seen = [[(k, view.camera) for k, view in enumerate(views)],
            [(k, view.projector) for k, view in enumerate(views) if view.projector is not None]]  # fmt: skip
    return tuple(
        CornerSightings(
            np.concatenate([np.full(len(corners.ids), k) for k, corners in of_device]),
            np.concatenate([p_board[corners.ids] for _, corners in of_device]),
            np.concatenate([corners.uv for _, corners in of_device]),
        )
        for of_device in seen
        if any(len(corners.ids) for _, corners in of_device)
    )


def residuals(rig: BoardRig, device: int, seen: CornerSightings) -> Float64[ndarray, "n 2"]:
    """Seen minus predicted pixels; `device` is 0 for the camera, 1 for the projector."""
    p = _in_device(rig, device, seen)[1]
    uv, in_front = project(Intrinsics.of(rig.devices[device], torch.float64), torch.from_numpy(p))
    return np.where(in_front.numpy()[:, None], seen.uv - uv.numpy(), _BEHIND_PX)


def derivatives(
    rig: BoardRig, device: int, free: FreeIntrinsics, seen: CornerSightings
) -> tuple[Float64[ndarray, "n 2 k"], Float64[ndarray, "n 2 6"], Float64[ndarray, "n 2 6"]]:
    """Derivatives of the predicted pixels by the fitted intrinsics, and by twists (v, w) from the left.

    The twists are those of T_projector_camera, by which the camera's pixels do not change, and of the view's board.
    """
    p_camera, p_device = _in_device(rig, device, seen)
    p = torch.from_numpy(p_device)
    by_point = project_jacobian(Intrinsics.of(rig.devices[device], torch.float64), p).numpy()
    R = rig.T_projector_camera[:3, :3] if device else np.eye(3)
    by_board = by_point @ R @ _by_twist(p_camera)
    by_rig = by_point @ _by_twist(p_device) if device else np.zeros_like(by_board)
    return _by_parameters(rig.devices[device], p) @ free.columns(), by_rig, by_board


def _in_device(
    rig: BoardRig, device: int, seen: CornerSightings
) -> tuple[Float64[ndarray, "n 3"], Float64[ndarray, "n 3"]]:
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
    o, one = np.zeros_like(x), np.ones_like(x)
    xd, yd = distort(x, y, device.k1, device.k2, device.p1, device.p2)
    lens_x, lens_y = lens_slopes(x, y)
    u = np.concatenate([np.stack([xd, o, one, o], -1), lens_x * device.fl_x], -1)
    v = np.concatenate([np.stack([o, yd, o, one], -1), lens_y * device.fl_y], -1)
    return np.stack([u, v], 1)


Free = tuple[FreeIntrinsics, ...]
"""Free intrinsics of the camera, and of the projector if there is one."""
Seen = tuple[CornerSightings, ...]
Sigma = tuple[float, ...]


@dataclass(frozen=True)
class AdjustedBoard:
    """The solution, its noise, and the normal equations without the boards."""

    rig: BoardRig
    free: Free
    sigma_px: Sigma  # of a coordinate of a corner in each device
    information: Float64[ndarray, "s s"]  # of the fitted intrinsics of each device, then of the rig's twist


def adjust(start: BoardRig, free: Free, seen: Seen, sigma_px: Sigma | None = None) -> AdjustedBoard:
    """The rig that explains the corners best. `sigma_px` holds the noise fixed; default: it is estimated."""
    rig = start
    sigma = sigma_px or noise(rig, free, seen)
    for _ in range(1 if sigma_px else _ROUNDS):
        found = minimise(
            rig,
            lambda rig, sigma=sigma: normal_equations(rig, free, seen, sigma),
            lambda rig, step: moved(rig, free, *step),
            lambda rig, sigma=sigma: _cost(rig, seen, sigma),
            tolerance=_TOLERANCE,
            damping=_FIRST_DAMPING,
        )
        rig, before = found.state, sigma
        sigma = sigma_px or noise(rig, free, seen)
        if np.allclose(before, sigma, rtol=_SETTLED):
            break
    return AdjustedBoard(rig, free, sigma, found.equations.reduced().H)


def covariance(information: Float64[ndarray, "s s"]) -> Float64[ndarray, "s s"]:
    """Covariance of the fitted numbers by the noise of the corners alone; huge where these do not determine them."""
    scale = 1 / np.sqrt(np.diag(information).clip(1e-300))
    values, vectors = np.linalg.eigh(information * scale[:, None] * scale)
    inverse = (vectors / values.clip(_SINGULAR * values.max())) @ vectors.T
    return inverse * scale[:, None] * scale


def place_boards(rig: BoardRig, seen: CornerSightings, sigma_px: float) -> BoardRig:
    """Every board where its corners in the camera put it; the rest of the rig stays."""
    free = FreeIntrinsics()
    for _ in range(_PLACING_STEPS):
        equations = normal_equations(replace(rig, projector=None), (free,), (seen,), (sigma_px,))
        steps = equations.blocks_after(np.zeros(free.columns().shape[1]))
        rig = replace(rig, T_camera_board=_exp(steps) @ rig.T_camera_board)
    return rig


def noise(rig: BoardRig, free: Free, seen: Seen) -> Sigma:
    """Robust standard deviation of a coordinate in each device, with the degrees of freedom of the whole fit."""
    fitted = sum(one.columns().shape[1] for one in free) + 6 * (len(free) - 1 + len(rig.T_camera_board))
    total = 2 * sum(len(one.view) for one in seen)
    freedom = np.sqrt(max(total - fitted, 1) / total)
    medians = [float(np.median(np.abs(residuals(rig, k, one)))) for k, one in enumerate(seen)]
    return tuple(max(MAD_TO_SIGMA * median / freedom, _LEAST_SIGMA) for median in medians)


def _cost(rig: BoardRig, seen: Seen, sigma: Sigma) -> float:
    costs = (kernel(residuals(rig, k, one) / s)[0] for k, (one, s) in enumerate(zip(seen, sigma, strict=True)))
    return sum(float(cost.sum()) for cost in costs) / 2


def kernel(whitened: Float64[ndarray, "n 2"]) -> tuple[Float64[ndarray, "n"], Float64[ndarray, "n"]]:
    """Geman-McClure cost of corners, and their weights, from residuals in standard deviations."""
    x = (whitened**2).sum(-1) / _KERNEL**2
    return _KERNEL**2 * geman_mcclure_cost(x), geman_mcclure_weight(x)


def normal_equations(rig: BoardRig, free: Free, seen: Seen, sigma: Sigma) -> BlockEquations:
    """Normal equations of all corners at a rig: shared numbers, and a block for each board."""
    begin = np.cumsum([0, *(one.columns().shape[1] for one in free)])
    size, boards = int(begin[-1]) + (6 if len(free) == 2 else 0), len(rig.T_camera_board)
    products = np.zeros((boards, size + 7, size + 7))  # of all columns: shared, of the board, residual
    for k, of_device in enumerate(seen):
        residual = residuals(rig, k, of_device)
        by_intrinsics, by_rig, by_board = derivatives(rig, k, free[k], of_device)
        weights = kernel(residual / sigma[k])[1]
        rows = np.zeros((len(weights), 2, size + 7))
        rows[..., begin[k] : begin[k + 1]] = by_intrinsics
        if k:
            rows[..., size - 6 : size] = by_rig
        rows[..., size : size + 6] = by_board
        rows[..., -1] = residual
        rows *= (np.sqrt(weights) / sigma[k])[:, None, None]
        ends = np.searchsorted(of_device.view, np.arange(boards + 1))  # corners are ordered by view
        for b in range(boards):
            own = rows[ends[b] : ends[b + 1]].reshape(-1, size + 7)
            products[b] += own.T @ own
    of_boards = slice(size, size + 6)
    return BlockEquations(
        products[:, :size, :size].sum(0),
        -products[:, :size, -1].sum(0),
        products[:, of_boards, of_boards],
        -products[:, of_boards, -1],
        products[:, :size, of_boards],
    )


def moved(rig: BoardRig, free: Free, shared: Float64[ndarray, "s"], boards: Float64[ndarray, "b 6"]) -> BoardRig:
    """The rig after a step of the shared numbers and of all boards."""
    devices, place = [], 0
    for device, one in zip(rig.devices, free, strict=True):
        columns = one.columns()
        values = device.parameters + columns @ shared[place : place + columns.shape[1]]
        devices.append(replace(device, **dict(zip(PARAMETERS, values.tolist(), strict=True))))
        place += columns.shape[1]
    T_projector_camera = rig.T_projector_camera
    if len(free) == 2:
        T_projector_camera = _exp(shared[None, -6:])[0] @ T_projector_camera
    T_camera_board = _exp(boards) @ rig.T_camera_board
    return BoardRig(devices[0], devices[1] if len(devices) > 1 else None, T_camera_board, T_projector_camera)


def _exp(twists: Float64[ndarray, "n 6"]) -> Float64[ndarray, "n 4 4"]:
    return exp_se3(torch.from_numpy(twists)).numpy()


# First solutions.


def camera_start(views: Sequence[BoardView], size: Size, p_board: Float64[ndarray, "m 3"]) -> AdjustedBoard:
    """The camera without lens distortion, and the boards."""
    w, h = size
    focals = [(share * max(size), aspect * share * max(size)) for share in _FOCAL_LENGTHS for aspect in _ASPECTS]
    found: list[tuple[float, BoardRig]] = []
    for fl_x, fl_y in [*focals, *_closed_form(views, size, p_board)]:
        camera = Device(w, h, fl_x, fl_y, w / 2, h / 2)
        solved = [_pose(camera, p_board, view.camera) for view in views]
        T = np.array([pose for pose, _ in solved])
        found.append((float(sum(cost for _, cost in solved)), BoardRig(camera, None, T, np.eye(4))))
    return _best(found, (), sightings(views, p_board)[:1])


def projector_start(
    camera: AdjustedBoard, views: Sequence[BoardView], size: Size, p_board: Float64[ndarray, "m 3"], model: DeviceKind
) -> AdjustedBoard:
    """The projector as well, without lens distortion: it sees all corners of all views in one frame, the camera's."""
    points, pixels = _seen_by_projector(camera.rig, views, p_board)
    w, h = size
    found: list[tuple[float, BoardRig]] = []
    for focal, aspect, centre in product(_FOCAL_LENGTHS, _ASPECTS, _CENTRES):
        device = Device(w, h, focal * w, aspect * focal * w, w / 2, centre * h, model=model)
        T, cost = _pose(device, points, Corners(np.arange(len(points)), pixels))
        found.append((cost, BoardRig(camera.rig.camera, device, camera.rig.T_camera_board, T)))
    return _best(found, camera.free, sightings(views, p_board))


def _best(found: list[tuple[float, BoardRig]], known: Free, seen: Seen) -> AdjustedBoard:
    """The best solution from the starts that fit best, with square pixels of the last device if they explain as much.

    `known` are the free intrinsics of the devices before the last.
    """
    ordered = [rig for _, rig in sorted(found, key=lambda one: one[0])]

    def best(square: bool) -> AdjustedBoard:
        free = (*known, FreeIntrinsics(aspect=not square))
        starts = [rig for rig in ordered if (rig.devices[-1].fl_x == rig.devices[-1].fl_y) == square]
        return min((adjust(rig, free, seen) for rig in starts[:_TRIED]), key=lambda one: one.sigma_px[-1])

    square, other = best(True), best(False)
    return square if square.sigma_px[-1] < _SQUARE * other.sigma_px[-1] else other


def _closed_form(
    views: Sequence[BoardView], size: Size, p_board: Float64[ndarray, "m 3"]
) -> Iterator[tuple[float, float]]:
    """One focal length for both axes, then two, from all homographies, with the principal point in the middle.

    Those that are imaginary are left out.
    """
    rows, right = [], []
    for view in views:
        if len(view.camera.ids) < _LEAST_CORNERS:
            continue
        H, _ = cv2.findHomography(p_board[view.camera.ids, :2], view.camera.uv - np.array(size) / 2)
        if H is None:
            continue
        first, second = H[:, 0], H[:, 1]
        scale = np.linalg.norm(first) * np.linalg.norm(second)
        rows += [first[:2] * second[:2] / scale, (first[:2] ** 2 - second[:2] ** 2) / scale]
        right += [-first[2] * second[2] / scale, (second[2] ** 2 - first[2] ** 2) / scale]
    by_axis, least = np.array(rows).reshape(-1, 2), 0.2 * max(size)
    for columns in (by_axis.sum(1, keepdims=True), by_axis) if rows else ():
        inverse = np.linalg.lstsq(columns, np.array(right), rcond=None)[0]
        if (inverse > 0).all():
            focal = np.clip(1 / np.sqrt(inverse), least, 250 * least)
            yield float(focal[0]), float(focal[-1])


def _pose(device: Device, points: Float64[ndarray, "m 3"], corners: Corners) -> tuple[Float64[ndarray, "4 4"], float]:
    """Pose of a device to points, and the sum of squared residuals, in pixels."""
    K = np.array([[device.fl_x, 0, device.cx], [0, device.fl_y, device.cy], [0, 0, 1]])
    lens = np.array([device.k1, device.k2, device.p1, device.p2])
    seen, uv = points[corners.ids], corners.uv
    middle = seen.mean(0)  # about which the solver is well conditioned
    flat = bool(np.ptp(points[:, 2]) == 0)
    ok, rotation, shift = cv2.solvePnP(
        (seen - middle)[:, None], uv[:, None], K, lens, flags=cv2.SOLVEPNP_IPPE if flat else cv2.SOLVEPNP_SQPNP
    )
    if not ok or not np.isfinite(rotation).all():
        return np.eye(4), np.inf
    ok, rotation, shift = cv2.solvePnP((seen - middle)[:, None], uv[:, None], K, lens, rotation, shift, True)
    again = cv2.projectPoints((seen - middle)[:, None], rotation, shift, K, lens)[0][:, 0]
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(rotation)[0]
    T[:3, 3] = shift[:, 0] - T[:3, :3] @ middle
    return Y_Z_DOWN @ T, float(((again - uv) ** 2).sum())


def _seen_by_projector(
    rig: BoardRig, views: Sequence[BoardView], p_board: Float64[ndarray, "m 3"]
) -> tuple[Float64[ndarray, "n 3"], Float64[ndarray, "n 2"]]:
    """Corners in the camera's frame, and in the pattern."""
    points, pixels = [], []
    for view, T in zip(views, rig.T_camera_board, strict=True):
        if view.projector is not None and len(view.projector.ids):
            points.append(p_board[view.projector.ids] @ T[:3, :3].T + T[:3, 3])
            pixels.append(view.projector.uv)
    return np.concatenate(points), np.concatenate(pixels)
