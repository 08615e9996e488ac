"""Intrinsics of camera and projector from corners of a board in several poses, with the uncertainty of every number.

Which intrinsics are fitted is decided by left-out views, whose boards are placed by their corners in the camera; their
corners in the projector are then predicted outright. Of all models the simplest is taken that is not worse than the
best one with certainty (a paired t test over the views): terms that only overfit are left out.

Uncertainty is the larger of two: by the noise of the corners, and by how much the views disagree (the jackknife; Efron
and Tibshirani, "An Introduction to the Bootstrap", 11), because a bent board or a lens that is not quite what its model
says makes errors that are common to all corners of a view. To it is added how far the numbers move with another model
that predicts left-out views no worse.
"""

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation
from scipy.special import stdtrit

from sl_nerfstudio.calibration.board_adjustment import (
    AdjustedBoard,
    BoardRig,
    BoardView,
    Corners,
    CornerSightings,
    Free,
    FreeIntrinsics,
    Seen,
    Sigma,
    adjust,
    board_points,
    camera_start,
    covariance,
    kernel,
    normal_equations,
    place_boards,
    projector_start,
    residuals,
    sightings,
)
from sl_nerfstudio.geometry.devices import PARAMETERS, Device, DeviceKind, Intrinsics, project, unproject
from sl_nerfstudio.geometry.numerics import MAD_TO_SIGMA
from sl_nerfstudio.pattern.boards import Board, Chessboard

# The choice of the model.

_TERMS = (0, 1, 2, 4)
_RICH = FreeIntrinsics(False, 2)  # of the projector while the camera's model is chosen
_RICHEST = FreeIntrinsics(True, 4)  # by whose noise errors are judged
_CERTAIN = 0.95  # one-sided
_MUCH_WORSE = 1.25  # mean cost relative to that of the best model
_LEAST_COST = 1e-12  # of noise-free corners
_FOLDS = 10  # views are left out one by one, or in so many groups
Track = Callable[[Sequence[int], str], Iterable[int]]


@dataclass(frozen=True)
class ModelScore:
    """Score of a device's model on left-out views."""

    device: int  # 0: camera, 1: projector
    model: FreeIntrinsics
    error_px: tuple[float, ...]  # RMS in each device over all left-out views
    costs: Float64[ndarray, "v"]  # mean robust cost of every view's corners when it was left out
    fitted: Device  # with this model, to all views
    chosen: bool = False


@dataclass(frozen=True)
class LeftOut:
    """Fits without some of the views, and how they predict those views."""

    whole: AdjustedBoard  # the fit to all views
    rigs: tuple[AdjustedBoard, ...]
    costs: Float64[ndarray, "v"]  # mean robust cost of every view's corners when it was left out
    error_px: tuple[float, ...]  # RMS of the predictions in each device
    by_view_px: Float64[ndarray, "d v"]  # the same for every view; NaN where a device does not see it


def choose_models(start: AdjustedBoard, seen: Seen, track: Track) -> tuple[Free, tuple[ModelScore, ...]]:
    """The model of each device, and what was compared: first the terms of the lens, then two focal lengths."""
    free: Free = (start.free[0], *(replace(_RICH, aspect=one.aspect) for one in start.free[1:]))
    sigma = adjust(start.rig, tuple(_RICHEST for _ in free), seen).sigma_px
    scores: list[ModelScore] = []
    for device, name in enumerate(("camera", "projector")[: len(free)]):

        def score(model: FreeIntrinsics, device: int = device, others: Free = free) -> ModelScore:
            tried = (*others[:device], model, *others[device + 1 :])
            found = leave_out(start.rig, tried, seen, sigma)
            return ModelScore(device, model, found.error_px, found.costs, found.whole.rig.devices[device])

        aspect = start.free[device].aspect
        found = [score(FreeIntrinsics(aspect, terms)) for terms in track(_TERMS, f"Lens models of the {name}")]
        if not aspect:
            found.append(score(FreeIntrinsics(True, found[_simplest(found)].model.terms)))
        best = _simplest(found)
        scores += [replace(one, chosen=k == best) for k, one in enumerate(found)]
        free = (*free[:device], found[best].model, *free[device + 1 :])
    return free, tuple(scores)


def leave_out(start: BoardRig, free: Free, seen: Seen, sigma: Sigma) -> LeftOut:
    """Fit without each group of views, and predict them. `sigma` is the noise by which errors are judged."""
    count = len(start.T_camera_board)
    costs, fits = np.full(count, np.nan), []
    squares: list[Float64[ndarray, v]] = [np.full(count, np.nan) for _ in seen]
    whole = adjust(start, free, seen, sigma)
    for group in np.array_split(np.arange(count), min(count, _FOLDS)):
        kept = np.setdiff1d(np.arange(count), group)
        fit = adjust(whole.rig.only(kept.tolist()), free, tuple(_of(one, kept) for one in seen), sigma)
        fits.append(fit)
        boards = replace(fit.rig, T_camera_board=whole.rig.T_camera_board[group])
        rig = place_boards(boards, _of(seen[0], group), sigma[0])
        for place, view in enumerate(group):
            total, corners = 0.0, 0
            for k, one in enumerate(seen):
                own = _of(_of(one, group), np.array([place]))
                if not len(own.view):
                    continue
                r = residuals(rig.only([place]), k, own)
                total, corners = total + float(kernel(r / sigma[k])[0].sum()), corners + len(r)
                squares[k][view] = float((r**2).mean())
            costs[view] = total / max(corners, 1)
    by_view = np.sqrt(np.array(squares))
    return LeftOut(whole, tuple(fits), costs, tuple(float(np.sqrt(np.nanmean(s))) for s in squares), by_view)


def _of(seen: CornerSightings, views: ndarray) -> CornerSightings:
    """The sightings of some views, which are numbered anew."""
    number = np.full(int(seen.view.max(initial=-1)) + 1 + int(views.max(initial=-1)) + 1, -1)
    number[views] = np.arange(len(views))
    own = number[seen.view] >= 0
    return CornerSightings(number[seen.view[own]], seen.p_board[own], seen.uv[own])


def _simplest(scores: Sequence[ModelScore]) -> int:
    """The simplest model that is not certainly worse than the best, nor much worse; views are compared one by one.

    The ratio of a view's costs is compared, not their difference: views that are hard for every model would hide how
    much the others differ. Few views make nothing certain, so a model must not cost much more in the mean, either.
    """
    best = min(scores, key=lambda one: one.costs.mean())

    def as_good(one: ModelScore) -> bool:
        ratio = np.log(one.costs.clip(_LEAST_COST) / best.costs.clip(_LEAST_COST))
        n = len(ratio)
        if one.costs.mean() > _MUCH_WORSE * best.costs.mean().clip(_LEAST_COST):
            return False
        return bool(ratio.mean() <= stdtrit(n - 1, _CERTAIN) * ratio.std(ddof=1) / np.sqrt(n))

    return min((k for k, one in enumerate(scores) if as_good(one)), key=lambda k: scores[k].model.columns().shape[1])


# Uncertainty.


@dataclass(frozen=True)
class DeviceSigma:
    """Standard deviation of every number of a device; 0 where it was not fitted."""

    values: dict[str, float]  # by the names in PARAMETERS

    def focal(self) -> float:
        """The sigma of the focal length, in pixels."""
        return max(self.values["fl_x"], self.values["fl_y"])

    def centre(self) -> float:
        """The sigma of the principal point, in pixels."""
        return max(self.values["cx"], self.values["cy"])


def device_sigmas(adjusted: AdjustedBoard, left_out: LeftOut, models: Sequence[ModelScore]) -> tuple[DeviceSigma, ...]:
    """The standard deviations of each device."""
    formal = formal_sigmas(adjusted.free, adjusted.information)
    out = []
    for k, one in enumerate(formal):
        fits = np.array([fit.rig.devices[k].parameters for fit in left_out.rigs])
        n = len(fits)
        jackknife = np.sqrt((n - 1) / n * ((fits - fits.mean(0)) ** 2).sum(0))
        sigma = np.hypot(np.maximum(one, jackknife), _by_model([score for score in models if score.device == k]))
        out.append(DeviceSigma(dict(zip(PARAMETERS, map(float, sigma), strict=True))))
    return tuple(out)


def _by_model(scores: Sequence[ModelScore]) -> Float64[ndarray, "8"]:
    """How far each number moves with another model that is at least as good; 0 where the other one does not fit it."""
    chosen = next(score for score in scores if score.chosen)
    fitted = chosen.model.columns().any(1)
    moves = [
        np.abs(score.fitted.parameters - chosen.fitted.parameters) * fitted
        for score in scores
        if score.costs.mean() <= chosen.costs.mean()
    ]
    return np.max(moves, axis=0)


def formal_sigmas(free: Free, information: Float64[ndarray, "s s"]) -> list[Float64[ndarray, "8"]]:
    """Sigmas of PARAMETERS of each device by the noise of the corners; `information` as in `AdjustedBoard`."""
    found, out, place = covariance(information), [], 0
    for one in free:
        columns = one.columns()
        part = slice(place, place + columns.shape[1])
        out.append(np.sqrt(np.einsum("ps,st,pt->p", columns, found[part, part], columns).clip(0)))
        place += columns.shape[1]
    return out


# Whether the lens is what its model says: corners that lie nearer to the middle of the image, or farther, than they
# should, by how far out they are. A polynomial that is too short for a lens alternates between the two.

_RINGS, _FEWEST_VIEWS, _FEWEST_OF_VIEW = 8, 3, 3
_RING_CHI_SQUARE = 30.0  # of all rings together; about as much as there are rings if the model is right
_WIDE = 0.6  # radius of the outermost corners in focal lengths, 31 degrees: narrower lenses have no such terms
_RING_SHARE = 0.25  # of the corners' noise: less matters to nothing


@dataclass(frozen=True)
class RadialMisfit:
    """How far corners lie outside of where the lens puts them, in the rings where that is largest; pixels."""

    inwards_px: float  # not positive
    outwards_px: float  # not negative


def radial_misfit(device: Device, seen: CornerSightings, residual: Float64[ndarray, "n 2"]) -> RadialMisfit | None:
    """Residual of a wide lens along its radius, in rings; None where it is chance, or below the noise.

    `residual` is seen minus predicted. Corners of a view share errors, so a ring is as certain as its views agree.
    """
    out = seen.uv - (device.cx, device.cy)
    radius = np.linalg.norm(out, axis=1)
    along = (residual * out).sum(1) / radius.clip(1e-9)
    noise = MAD_TO_SIGMA * float(np.median(np.abs(residual - np.median(residual, 0))))
    middles, chi_square = [0.0], 0.0
    for ring in np.array_split(np.argsort(radius), _RINGS):
        of_view = [along[ring][seen.view[ring] == k] for k in np.unique(seen.view[ring])]
        medians = np.array([np.median(values) for values in of_view if len(values) >= _FEWEST_OF_VIEW])
        if len(medians) >= _FEWEST_VIEWS:
            middles.append(float(np.median(medians)))
            sigma = max(float(medians.std(ddof=1)), _RING_SHARE * noise) / np.sqrt(len(medians))
            chi_square += float(medians.mean() / sigma) ** 2
    wide = float(np.quantile(radius, 0.98)) > _WIDE * device.fl_x
    if not wide or chi_square < _RING_CHI_SQUARE or max(map(abs, middles)) < _RING_SHARE * noise:
        return None
    return RadialMisfit(min(middles), max(middles))


# How varied the views are, and which further pose of the board would help most.

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
    """Variety of the views."""

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


def coverage_of(adjusted: AdjustedBoard, views: Sequence[BoardView]) -> Coverage:
    """Variety of the views."""
    rig = adjusted.rig
    normals, distance = rig.T_camera_board[:, :3, 2], np.linalg.norm(rig.T_camera_board[:, :3, 3], axis=1)
    tilt = np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1).min()))
    in_pattern = [view.projector for view in views if view.projector is not None]
    camera = _filled([view.camera for view in views], rig.camera)
    projector = None if rig.projector is None else _filled(in_pattern, rig.projector)
    return Coverage(float(tilt), float(distance.max() / distance.min()), camera, projector)


def _filled(corners: Sequence[Corners], device: Device) -> float:
    """Share of the cells of a device's image that hold a corner."""
    uv = np.concatenate([one.uv for one in corners]) if corners else np.zeros((0, 2))
    column, row = (np.clip(uv / (device.w, device.h), 0, 1 - 1e-9) * _GRID).astype(int).T
    filled = np.zeros(_GRID[::-1], dtype=bool)
    filled[row, column] = True
    return float(filled.mean())


def next_pose(adjusted: AdjustedBoard, p_board: Float64[ndarray, "m 3"]) -> NextPose | None:
    """Tried out on boards in many places: what the corners of each would add. None if no board fits the images."""
    _, before = _relative_sigma(adjusted, adjusted.information)
    found: list[tuple[float, NextPose]] = []
    for words, T in _boards(adjusted.rig, p_board):
        information = _added(adjusted, T, p_board)
        if information is not None:
            score, focal = _relative_sigma(adjusted, adjusted.information + information)
            found.append((score, NextPose(*words, focal, before)))
    return min(found, key=lambda one: one[0])[1] if found else None


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


def _added(adjusted: AdjustedBoard, T: ndarray, p_board: Float64[ndarray, "m 3"]) -> Float64[ndarray, "s s"] | None:
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
    return normal_equations(rig, adjusted.free, sightings([view], p_board), adjusted.sigma_px).reduced().H


def _relative_sigma(adjusted: AdjustedBoard, information: Float64[ndarray, "s s"]) -> tuple[float, float]:
    """Sigma of focal length and principal point together, of the worse device; and of the focal length alone."""
    sigmas = formal_sigmas(adjusted.free, information)
    relative = [s[:4] / device.fl_x for s, device in zip(sigmas, adjusted.rig.devices, strict=True)]
    return max(float(np.linalg.norm(s)) for s in relative), max(float(s[:2].max()) for s in relative)


# The whole calibration, and its file.

FEWEST_VIEWS = 3  # two determine focal length and principal point; a third can contradict them
Size = tuple[int, int]


@dataclass(frozen=True)
class BoardCalibration:
    """Both devices, and all by which they can be judged."""

    board: Board
    views: tuple[BoardView, ...]
    adjusted: AdjustedBoard
    sigmas: tuple[DeviceSigma, ...]  # of the camera, and of the projector if there is one
    rms_px: tuple[float, ...]  # over all corners, outliers included
    residuals: tuple[tuple[Float64[ndarray, "_ 2"], ...], ...]  # of each device, of each view, seen minus predicted
    left_out: LeftOut
    models: tuple[ModelScore, ...]
    coverage: Coverage
    next_pose: NextPose | None
    misfit: RadialMisfit | None  # of the camera's lens; a projector's corners come through a homography each

    @property
    def camera(self) -> Device:
        """The camera."""
        return self.adjusted.rig.camera

    @property
    def projector(self) -> Device | None:
        """The projector; None if the pattern was not seen."""
        return self.adjusted.rig.projector

    @property
    def free(self) -> tuple[FreeIntrinsics, ...]:
        """The fitted intrinsics of each device."""
        return self.adjusted.free


def calibrate(
    views: Sequence[BoardView],
    board: Board,
    camera_size: Size,
    pattern_size: Size | None,
    model: DeviceKind,
    track: Track,
) -> BoardCalibration:
    """Calibrate from at least three views. `pattern_size` None: the camera alone. `model` is the projector's."""
    assert len(views) >= FEWEST_VIEWS
    p_board = board_points(board.corners())
    if pattern_size is None:
        views = [BoardView(view.name, view.camera, None) for view in views]
    seen = sightings(views, p_board)
    start = camera_start(views, camera_size, p_board)
    if pattern_size is not None:
        start = projector_start(start, views, pattern_size, p_board, model)
    free, models = choose_models(start, seen, track)
    adjusted = adjust(start.rig, free, seen)
    left_out = leave_out(adjusted.rig, free, seen, adjusted.sigma_px)
    all_residuals = [residuals(adjusted.rig, k, one) for k, one in enumerate(seen)]
    return BoardCalibration(
        board,
        tuple(views),
        adjusted,
        device_sigmas(adjusted, left_out, models),
        tuple(float(np.sqrt((r**2).mean())) for r in all_residuals),
        tuple(tuple(r[one.view == k] for k in range(len(views))) for r, one in zip(all_residuals, seen, strict=True)),
        left_out,
        models,
        coverage_of(adjusted, views),
        next_pose(adjusted, p_board),
        radial_misfit(adjusted.rig.camera, seen[0], all_residuals[0]),
    )


MARK = b'"sl_calibration": 1'
"""Text by which an earlier result of this command is known."""


def encode_calibration(found: BoardCalibration, verdict: str, reasons: tuple[str, ...]) -> bytes:
    """Encode a calibration as the JSON that sl-process reads."""
    document: dict[str, Any] = {"sl_calibration": 1, "units": "mm", "verdict": verdict, "reasons": list(reasons)}
    for name, device, sigma in zip(("camera", "projector"), found.adjusted.rig.devices, found.sigmas, strict=False):
        document[name] = {**asdict(device), "sigma": {key: value for key, value in sigma.values.items() if value}}
    if found.projector is not None:
        document["T_projector_camera"] = found.adjusted.rig.T_projector_camera.tolist()
    kind = "chessboard" if isinstance(found.board, Chessboard) else "charuco"
    document["board"] = {"kind": kind, **asdict(found.board)}
    document["rms_px"] = list(found.rms_px)
    document["left_out_px"] = list(found.left_out.error_px)
    document["poses"] = [
        {"name": view.name, "rms_px": [_rms(of_device[k]) for of_device in found.residuals],
         "T_camera_board": found.adjusted.rig.T_camera_board[k].tolist()}
        for k, view in enumerate(found.views)
    ]  # fmt: skip
    return (json.dumps(document, indent=1, allow_nan=False) + "\n").encode()


def _rms(residuals: np.ndarray) -> float | None:
    return float(np.sqrt((residuals**2).mean())) if len(residuals) else None
