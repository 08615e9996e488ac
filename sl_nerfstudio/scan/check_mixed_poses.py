"""Poses that are right for other frames, or in another world: one copied to all frames, out of step, moved together.

Each frame's coordinates say what its two poses may be relative to each other. Poses of the cameras and of the
projectors that come from two programs, or from two lists, are each right and do not belong together. Undoing one such
mistake must bring the rays of nearly all frames together, as far as the scan states its uncertainty.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.least_squares import NormalEquations, minimise
from sl_nerfstudio.geometry.lie import (
    AXIS_TURNS,
    DevicePoses,
    Similarity,
    angle_deg,
    axis_words,
    exp_so3,
    fit_similarity,
)
from sl_nerfstudio.geometry.triangulation import epipolar_residual
from sl_nerfstudio.scan.check_geometry import Correspondences, GeometricFit, fit_geometry, geometry_of
from sl_nerfstudio.scan.document import Problem

# Epipolar residuals as fractions of the projector's focal length: angles in radians.
SUSPECT = 0.01  # 0.6 degrees: worse than auto-calibration usually is
SUSPECT_SIGMAS = 2.5  # of the stated uncertainty, in the median over the frames: by chance one in a thousand scans
_MUCH_BETTER = 0.4  # factor by which undoing a mistake must lower the residual
_MUCH_BETTER_UNSTATED = 0.2  # the same where rough poses may be honest
_NEARLY_ALL = 0.75  # share of the frames in which it must; a list that is out of step is wrong at its ends
_FEWEST_FRAMES = 4  # that can tell a mistake in all of them from chance
_EQUAL = 1e-6  # largest difference of rotations, and of positions in distances between the devices, of copied poses

Kind = Literal["camera", "projector"]
_KEYS: dict[Kind, str] = {"camera": "transform_matrix", "projector": "projector_transform_matrix"}


def _stacked(frames: Sequence[Correspondences], kind: Kind) -> Float64[ndarray, "n 4 4"]:
    """The poses of one kind of device."""
    return np.stack([getattr(frame, f"T_world_{kind}") for frame in frames])


def is_suspect(fit: GeometricFit, focal: float) -> bool:
    """Whether the rays of most frames miss each other by more than is stated, or else usual."""
    if np.isfinite(fit.typical_excess):
        return fit.typical_excess > SUSPECT_SIGMAS
    return fit.typical_px > SUSPECT * focal


# One pose in all frames.


def copied_poses(frames: Sequence[Correspondences], given: GeometricFit, focal: float) -> tuple[str, Problem] | None:
    """(key, problem) if one pose stands in most frames and fits few of them; None otherwise.

    A device that stands still has one pose as well: then it fits.
    """
    stated = np.where(np.isnan(given.stated_px), SUSPECT * focal, SUSPECT_SIGMAS * given.stated_px)
    bad = given.residual_px > stated  # their rays miss each other by more than is stated for them, or else usual
    if len(frames) < 3 or bad.mean() < 0.5 or bad.all():  # it fits the frame that it was copied from
        return None
    T = DevicePoses(_stacked(frames, "camera"), _stacked(frames, "projector"))
    length = max(float(np.median(T.baseline)), 1e-300)
    camera, projector = _same(T.T_world_camera, length), _same(T.T_world_projector, length)
    relative = _same(T.T_camera_projector, length)
    found: tuple[tuple[Kind, ndarray], ...] = (("camera", camera), ("projector", projector), ("projector", relative))
    for kind, same in found:
        if len(same) > len(frames) / 2:
            what, first, others = "is the same", frames[same[0]].name, len(same) - 1
            cause = f"moved between the frames, and the pose of {first} was copied to {others} others"
            if same is relative:
                what = "lies in the same place relative to the camera"
                cause = "moved against the camera between the frames, and one calibration of the two was copied"
            return _KEYS[kind], Problem(
                f"{what} in {len(same)} of {len(frames)} frames, and it fits the coordinates of {int((~bad).sum())} of "
                f"{len(frames)} frames; rays miss each other by {given.typical_px:.0f} px",
                f"the {kind} {cause}",
                f"give each frame its own pose of the {kind}; where none is known, make the scan from the photographs: "
                "sl-process finds both poses of every frame",
            )
    return None


def _same(T: Float64[ndarray, "n 4 4"], length: float) -> ndarray:
    """Indices of the largest group of poses that are equal; lengths count in units of `length`."""
    flat = np.concatenate([T[:, :3, :3].reshape(-1, 9), T[:, :3, 3] / length], 1)
    equal = np.abs(flat[:, None] - flat[None]).max(-1) < _EQUAL
    return np.flatnonzero(equal[int(equal.sum(1).argmax())])


# Poses in another order, and in another world.


@dataclass(frozen=True)
class _Mistake:
    """A mistake with what it leaves when it is undone."""

    frames: list[Correspondences]
    key: str
    cause: str
    remedy: str


def mixed_poses(
    frames: Sequence[Correspondences], projector: Device, given: GeometricFit
) -> tuple[str, Problem] | None:
    """(key, problem) if poses in another order, or moved together, explain the residuals; None otherwise.

    The order is tried first: it leaves nothing to be fitted.
    """
    focal = (projector.fl_x + projector.fl_y) / 2
    if len(frames) < _FEWEST_FRAMES or not is_suspect(given, focal):
        return None
    for mistakes in (_orders(frames), _turns(frames), _worlds(frames, projector)):
        found = [(fit_geometry(mistake.frames, projector), mistake) for mistake in mistakes]
        fitting = [(fit.typical_px, k) for k, (fit, _) in enumerate(found) if _explains(given, fit, focal)]
        if fitting:
            px, k = min(fitting)
            mistake = found[k][1]
            allowed = "" if np.isnan(given.typical_excess) else (
                f"; the stated uncertainty explains {np.nanmedian(given.stated_px):.0f} px"
            )  # fmt: skip
            return mistake.key, Problem(
                f"does not fit the coordinates: rays of camera and projector miss each other by "
                f"{given.typical_px:.0f} px (median){allowed}",
                f"{mistake.cause}: interpreted that way they miss by {px:.0f} px",
                mistake.remedy,
            )
    return None


def _explains(given: GeometricFit, fit: GeometricFit, focal: float) -> bool:
    """Whether nearly all frames fit, and so much better than before that it cannot be chance."""
    better = _MUCH_BETTER if np.isfinite(given.typical_excess) else _MUCH_BETTER_UNSTATED
    return bool((fit.residual_px < better * given.typical_px).mean() >= _NEARLY_ALL) and not is_suspect(fit, focal)


def _orders(frames: Sequence[Correspondences]) -> Iterator[_Mistake]:
    """The poses of one kind of device, or of both, late or early by some frames, or in reverse."""
    count = len(frames)
    kinds: tuple[tuple[Kind, ...], ...] = (("camera",), ("projector",), ("camera", "projector"))
    shifts = [s for k in range(1, min(_MOST_SHIFT, count // 2) + 1) for s in (k, -k)]
    orders = [*((s, np.roll(np.arange(count), -s)) for s in shifts), (0, np.arange(count)[::-1])]
    for which, (shift, order) in product(kinds, orders):
        poses = [{f"T_world_{kind}": getattr(frames[k], f"T_world_{kind}") for kind in which} for k in order]
        whose = "poses of both devices" if len(which) > 1 else f"{which[0]} poses"
        many = "one frame" if abs(shift) == 1 else f"{abs(shift)} frames"
        a, b = frames[0].name, frames[order[0]].name
        how = f"{many} {'late' if shift > 0 else 'early'}" if shift else "in reverse order"
        yield _Mistake(
            [replace(frame, **moved) for frame, moved in zip(frames, poses, strict=True)],
            _KEYS[which[0]],
            f"the {whose} are {how} (that of {a} stands at {b})",
            f"put the {whose} in the order of the images: compare the two lists, their first and their last entry",
        )


_MOST_SHIFT = 5  # frames by which a list of poses may be early or late
_CAUSE = "the camera poses and the projector poses are in two different worlds"


def _turns(frames: Sequence[Correspondences]) -> Iterator[_Mistake]:
    """The camera poses with axes exchanged against the projector poses."""
    for R in AXIS_TURNS:
        yield _Mistake(
            _moved(frames, Similarity(1.0, R, np.zeros(3))),
            _KEYS["camera"],
            f"{_CAUSE}: x, y, z of the projectors' are {axis_words(R)} of the cameras'",
            "exchange the axes of the one: a program turned the poses of one kind of device alone (nerfstudio: "
            f"applied_transform); the camera poses fit if multiplied on the left by {_rows(R)}",
        )


_POINTS, _MOST_FRAMES = 40, 30  # of which one motion of all cameras is found
_KERNEL = 0.02  # of the focal length: residuals beyond count less
_MOST_STARTS = 3  # from which a motion is refined
_STEP = 1e-6  # radian, and of the cameras' distances: for derivatives


def _worlds(frames: Sequence[Correspondences], projector: Device) -> Iterator[_Mistake]:
    """The camera poses turned, scaled and shifted together against the projector poses."""
    step = max(1, len(frames[0].uv_camera) // _POINTS)
    some = [
        replace(f, uv_camera=f.uv_camera[::step], uv_projector=f.uv_projector[::step])
        for f in frames[:: max(1, len(frames) // _MOST_FRAMES)]
    ]
    kernel_px = _KERNEL * (projector.fl_x + projector.fl_y) / 2
    camera, _, uv, intrinsics, T_world_projector, uv_projector = geometry_of(some, projector)
    T_world_camera = _stacked(some, "camera")

    def residuals(S: Similarity) -> Float64[ndarray, "m"]:
        """Bounded: those far beyond the kernel, and rays that meet behind a device, count alike."""
        T = torch.from_numpy(S.poses(T_world_camera))[:, None]
        px = epipolar_residual(camera, T, uv, intrinsics, T_world_projector, uv_projector)
        return np.arctan(px.nan_to_num(nan=torch.inf).flatten().numpy() / kernel_px) * kernel_px

    def cost(S: Similarity) -> float:
        return float((residuals(S) ** 2).sum() / 2)

    starts = sorted(_starts(frames), key=cost)[:_MOST_STARTS]
    positions = T_world_camera[:, :3, 3]
    S = min((_nearest_minimum(start, positions, residuals, cost) for start in starts), key=cost)
    yield _Mistake(
        _moved(frames, S),
        _KEYS["camera"],
        f"{_CAUSE}: the cameras' turned by {angle_deg(S.R):.3g} degrees and scaled by {S.scale:.4g} is the projectors'",
        "bring both into one world: a program turned, scaled or centred the poses of one kind of device alone "
        f"(nerfstudio: applied_transform, orientation, scaling); the camera poses fit if their rotations are "
        f"multiplied on the left by {_rows(S.R)}, and their positions likewise, times {S.scale:.4g}, plus "
        f"{_rows(S.t[None])}",
    )


def _moved(frames: Sequence[Correspondences], S: Similarity) -> list[Correspondences]:
    """The frames with all cameras moved."""
    moved = S.poses(_stacked(frames, "camera"))
    return [replace(frame, T_world_camera=T) for frame, T in zip(frames, moved, strict=True)]


def _rows(values: Float64[ndarray, "m n"]) -> str:
    return "[" + "; ".join(", ".join(f"{value:.4g}" for value in row) for row in values + 0.0) + "]"


def _starts(frames: Sequence[Correspondences]) -> Iterator[Similarity]:
    """Motions of the cameras that may bring them to their projectors: the two are near each other and look alike."""
    camera, projector = _stacked(frames, "camera"), _stacked(frames, "projector")
    yield from (Similarity(1.0, R, np.zeros(3)) for R in AXIS_TURNS)
    yield fit_similarity(camera[:, :3, 3], projector[:, :3, 3])
    U, _, Vt = np.linalg.svd((projector[:, :3, :3] @ camera[:, :3, :3].transpose(0, 2, 1)).sum(0))
    R = (U * np.array([1.0, 1.0, np.linalg.det(U @ Vt)])) @ Vt
    middles = [T[:, :3, 3].mean(0) for T in (camera, projector)]
    spreads = [
        np.linalg.norm(T[:, :3, 3] - middle, axis=1).mean()
        for T, middle in zip((camera, projector), middles, strict=True)
    ]
    scale = float(spreads[1] / max(spreads[0], 1e-300)) or 1.0
    yield Similarity(scale, R, middles[1] - scale * R @ middles[0])


def _nearest_minimum(
    start: Similarity,
    positions: Float64[ndarray, "n 3"],
    residuals: Callable[[Similarity], Float64[ndarray, "m"]],
    cost: Callable[[Similarity], float],
) -> Similarity:
    """The motion of all cameras, at these positions, that a search from `start` ends in."""
    centres = start.points(positions)
    middle = centres.mean(0)
    size = max(float(np.linalg.norm(centres - middle, axis=1).max()), 1e-300)

    def moved(S: Similarity, x: Float64[ndarray, "7"]) -> Similarity:
        R = exp_so3(torch.from_numpy(x[:3].copy())).numpy()
        scale = float(np.exp(x[6]))
        return Similarity(scale, R, middle + size * x[3:6] - scale * R @ middle) @ S

    def equations(S: Similarity) -> NormalEquations:
        steps = _STEP * np.eye(7)
        J = np.stack([(residuals(moved(S, x)) - residuals(moved(S, -x))) / (2 * _STEP) for x in steps], 1)
        return NormalEquations.of(J, residuals(S))

    return minimise(start, equations, moved, cost, iterations=40, tolerance=1e-6).state
