"""Errors of the starting poses, as auto-calibration and registration make them; nothing here renders.

Auto-calibration errs in a projector's pose against its camera: rotation, direction and length of the baseline.
The frame's triangulated points are then a little deformed and of a wrong size, and registration puts *them* onto
the others: a baseline 2 % too long moves camera and projector about 2 % away from the object. Registration's own error
moves a frame as a whole, turning it about the object.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from numpy import ndarray

from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.devices import Intrinsics
from sl_nerfstudio.geometry.se3 import exp_so3, log_so3
from sl_nerfstudio.geometry.similarity import fit_similarity
from sl_nerfstudio.geometry.triangulation import triangulate
from sl_nerfstudio.scan.types import PoseSigma
from sl_nerfstudio.synthesis.devices import Pair

_FEWEST_POINTS = 20  # with fewer, a frame is not registered anew


@dataclass(frozen=True)
class PoseNoise:
    """Root mean squares over the frames; each is met exactly by every scan."""

    rotation_deg: float  # of a frame about the object
    translation: float  # of a frame, at the object, millimetres
    relative_rotation_deg: float  # projector against camera
    baseline_direction_deg: float
    baseline_length: float  # as a fraction
    first_baseline_exact: bool = True

    @property
    def is_zero(self) -> bool:
        """Whether the poses stay exact."""
        return not (self.rotation_deg or self.translation or self.disturbs_relative)

    @property
    def disturbs_relative(self) -> bool:
        """Whether auto-calibration errs."""
        return bool(self.relative_rotation_deg or self.baseline_direction_deg or self.baseline_length)


@dataclass(frozen=True)
class Correspondences:
    """Exact matches of one frame, to register its disturbed points by."""

    uv_camera: Float[ndarray, "n 2"]
    uv_projector: Float[ndarray, "n 2"]
    p_world: Float[ndarray, "n 3"]


def disturb_poses(
    truth: DevicePoses,
    noise: PoseNoise,
    centre: Float[ndarray, "3"],
    devices: Pair,
    matches: list[Correspondences],
    rng: np.random.Generator,
) -> DevicePoses:
    """Starting poses: auto-calibration errors, registration of what they yield, registration errors."""
    if noise.is_zero:
        return truth
    T_camera_projector = np.linalg.inv(truth.T_world_camera) @ truth.T_world_projector
    calibrated = disturb_relative(T_camera_projector, noise, rng)
    camera = truth.T_world_camera.copy()
    if noise.disturbs_relative:
        for n, match in enumerate(matches):
            camera[n] = _registered(camera[n], calibrated[n], devices, match)
    motion = _motions_about(centre, len(camera), noise, rng)
    camera = motion @ camera
    return DevicePoses(camera, camera @ calibrated)


def disturb_relative(
    T_camera_projector: Float64[ndarray, "n 4 4"], noise: PoseNoise, rng: np.random.Generator
) -> Float64[ndarray, "n 4 4"]:
    """Auto-calibration errors. Those of the logarithms of the lengths have mean zero."""
    n = len(T_camera_projector)
    out = T_camera_projector.copy()
    turn = _rotations(np.radians(noise.relative_rotation_deg), n, rng)
    out[:, :3, :3] = T_camera_projector[:, :3, :3] @ turn
    baseline = T_camera_projector[:, :3, 3]
    swing = np.cross(baseline, rng.standard_normal((n, 3)))  # an axis square to the baseline: only the direction turns
    swing = swing / np.linalg.norm(swing, axis=1, keepdims=True) * np.abs(rng.standard_normal((n, 1)))
    swing = _with_rms(swing, np.radians(noise.baseline_direction_deg))
    length = np.exp(_log_lengths(n, noise, rng))
    out[:, :3, 3] = length[:, None] * (_exp(swing) @ baseline[:, :, None])[:, :, 0]
    return out


def pose_sigma(truth: DevicePoses, start: DevicePoses, centre: Float[ndarray, "3"]) -> PoseSigma | None:
    """Standard deviation along each axis (RMS length / sqrt(3)) of the errors that `start` really has.

    "Camera" errors are those of the frame as a whole, turning about `centre`, where the translation is taken.
    None where the poses are exact.
    """
    moved = start.T_world_camera @ np.linalg.inv(truth.T_world_camera)
    shift = (moved[:, :3, :3] @ centre + moved[:, :3, 3]) - centre
    relative = np.linalg.inv(truth.T_world_camera) @ truth.T_world_projector
    relative_start = np.linalg.inv(start.T_world_camera) @ start.T_world_projector
    turned = relative[:, :3, :3].transpose(0, 2, 1) @ relative_start[:, :3, :3]
    values = (
        _sigma(shift),
        np.degrees(_sigma(_log(moved[:, :3, :3]))),
        _sigma(relative_start[:, :3, 3] - relative[:, :3, 3]),
        np.degrees(_sigma(_log(turned))),
    )
    if max(values) < 1e-9:
        return None
    # an error of zero is no statement of a prior; something far below what data can tell stands for it
    floors = (1e-6 * np.linalg.norm(truth.T_world_camera[0, :3, 3] - centre), 1e-4) * 2
    return PoseSigma(*(float(max(value, floor)) for value, floor in zip(values, floors, strict=True)))


def _registered(
    T_world_camera: Float64[ndarray, "4 4"],
    T_camera_projector: Float64[ndarray, "4 4"],
    devices: Pair,
    match: Correspondences,
) -> Float64[ndarray, "4 4"]:
    """The camera pose for which the points that the disturbed rig triangulates fit best onto the true ones."""
    start = T_world_camera, T_world_camera @ T_camera_projector
    points = triangulate(
        Intrinsics.of(devices.camera, torch.float64),
        torch.from_numpy(start[0]),
        torch.from_numpy(match.uv_camera),
        Intrinsics.of(devices.projector, torch.float64),
        torch.from_numpy(start[1]),
        torch.from_numpy(match.uv_projector),
    )
    p = points.p_world.numpy()
    known = np.isfinite(p).all(-1)
    if known.sum() < _FEWEST_POINTS:
        return T_world_camera
    return fit_similarity(p[known], match.p_world[known], with_scale=False).matrix() @ T_world_camera


def _motions_about(
    centre: Float[ndarray, "3"], n: int, noise: PoseNoise, rng: np.random.Generator
) -> Float64[ndarray, "n 4 4"]:
    """Random rigid motions: a rotation about `centre`, then a shift."""
    out = np.tile(np.eye(4), (n, 1, 1))
    out[:, :3, :3] = _rotations(np.radians(noise.rotation_deg), n, rng)
    shift = _with_rms(rng.standard_normal((n, 3)), noise.translation)
    out[:, :3, 3] = centre - out[:, :3, :3] @ centre + shift
    return out


def _log_lengths(n: int, noise: PoseNoise, rng: np.random.Generator) -> Float[ndarray, "n"]:
    """Errors of the baselines' logarithms: mean zero, RMS as asked over the frames that have an error."""
    value = rng.standard_normal(n)
    free = np.ones(n, dtype=bool)
    free[0] = not noise.first_baseline_exact
    if free.sum() < 2:  # one error alone cannot have mean zero
        return np.zeros(n)
    value[free] -= value[free].mean()
    value[~free] = 0.0
    value[free] *= noise.baseline_length / np.sqrt((value[free] ** 2).mean())
    return value


def _rotations(rms: float, n: int, rng: np.random.Generator) -> Float64[ndarray, "n 3 3"]:
    return _exp(_with_rms(rng.standard_normal((n, 3)), rms))


def _with_rms(vectors: Float[ndarray, "n 3"], rms: float) -> Float[ndarray, "n 3"]:
    return vectors * (rms / np.sqrt((vectors**2).sum(-1).mean()))


def _sigma(vectors: Float[ndarray, "n 3"]) -> float:
    return float(np.sqrt((vectors**2).mean()))


def _exp(w: Float[ndarray, "n 3"]) -> Float64[ndarray, "n 3 3"]:
    return exp_so3(torch.from_numpy(w)).numpy()


def _log(R: Float[ndarray, "n 3 3"]) -> Float64[ndarray, "n 3"]:
    return log_so3(torch.from_numpy(np.ascontiguousarray(R))).numpy()
