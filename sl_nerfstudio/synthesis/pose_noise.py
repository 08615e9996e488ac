"""Errors of the starting poses, like those of auto-calibration and registration; nothing here renders.

Auto-calibration has errors in the pose of a projector relative to its camera: rotation, direction and length of the
baseline. The frame's triangulated points are then slightly deformed and have a wrong size, and registration aligns
*them* with the others: a baseline 2 % too long moves camera and projector about 2 % away from the object. The error of
registration itself moves a frame as a whole and rotates it about the object.
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
from sl_nerfstudio.synthesis.devices import DevicePair

_FEWEST_POINTS = 20  # with fewer, a frame is not registered again


@dataclass(frozen=True)
class PoseNoise:
    """Root mean squares over the frames; every scan has exactly these values."""

    rotation_deg: float  # of a frame about the object
    translation: float  # of a frame, at the object, millimetres
    relative_rotation_deg: float  # projector relative to camera
    baseline_direction_deg: float
    baseline_length: float  # as a fraction
    first_baseline_exact: bool = True

    @property
    def is_zero(self) -> bool:
        """Whether the poses stay exact."""
        return not (self.rotation_deg or self.translation or self.disturbs_relative)

    @property
    def disturbs_relative(self) -> bool:
        """Whether auto-calibration has errors."""
        return bool(self.relative_rotation_deg or self.baseline_direction_deg or self.baseline_length)


@dataclass(frozen=True)
class ExactMatches:
    """Exact matches of one frame, with which its disturbed points are registered."""

    uv_camera: Float[ndarray, "n 2"]
    uv_projector: Float[ndarray, "n 2"]
    p_world: Float[ndarray, "n 3"]


def disturb_poses(
    truth: DevicePoses,
    noise: PoseNoise,
    centre: Float[ndarray, "3"],
    devices: DevicePair,
    matches: list[ExactMatches],
    rng: np.random.Generator,
) -> DevicePoses:
    """Starting poses: errors of auto-calibration, registration of the resulting points, errors of registration."""
    if noise.is_zero:
        return truth
    calibrated = disturb_relative(truth.T_camera_projector, noise, rng)
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
    swing = np.cross(baseline, rng.standard_normal((n, 3)))  # about axes perpendicular to the baseline
    swing = swing / np.linalg.norm(swing, axis=1, keepdims=True) * np.abs(rng.standard_normal((n, 1)))
    swing = _with_rms(swing, np.radians(noise.baseline_direction_deg))
    length = np.exp(_log_lengths(n, noise, rng))
    out[:, :3, 3] = length[:, None] * (_exp(swing) @ baseline[:, :, None])[:, :, 0]
    return out


def pose_sigma(truth: DevicePoses, start: DevicePoses, centre: Float[ndarray, "3"]) -> PoseSigma | None:
    """Standard deviation along each axis (RMS length / sqrt(3)) of the errors that `start` really has.

    "Camera" errors are those of the frame as a whole: its rotation about `centre`, and the translation of `centre`.
    None if the poses are exact.
    """
    moved = start.T_world_camera @ np.linalg.inv(truth.T_world_camera)
    shift = (moved[:, :3, :3] @ centre + moved[:, :3, 3]) - centre
    relative, relative_start = truth.T_camera_projector, start.T_camera_projector
    turned = relative[:, :3, :3].transpose(0, 2, 1) @ relative_start[:, :3, :3]
    values = (
        _sigma(shift),
        np.degrees(_sigma(_log(moved[:, :3, :3]))),
        _sigma(relative_start[:, :3, 3] - relative[:, :3, 3]),
        np.degrees(_sigma(_log(turned))),
    )
    if max(values) < 1e-9:
        return None
    # a prior cannot have a sigma of zero; a value far below what data can resolve takes its place
    floors = (1e-6 * np.linalg.norm(truth.T_world_camera[0, :3, 3] - centre), 1e-4) * 2
    return PoseSigma(*(float(max(value, floor)) for value, floor in zip(values, floors, strict=True)))


def _registered(
    T_world_camera: Float64[ndarray, "4 4"],
    T_camera_projector: Float64[ndarray, "4 4"],
    devices: DevicePair,
    match: ExactMatches,
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
    """Errors of the baselines' logarithms: mean zero, the given RMS over the frames that have an error."""
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
