"""Ways in which poses and coordinates may be meant that differ from this format's, and how well each fits."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial import KDTree
from torch import Tensor

from sl_nerfstudio.geometry.devices import Device, Intrinsics
from sl_nerfstudio.geometry.epipolar import epipolar_residual
from sl_nerfstudio.geometry.triangulation import triangulate
from sl_nerfstudio.scan.check.correspondences import Correspondences

PoseReading = Literal["as given", "inverted", "OpenCV axes", "inverted, OpenCV axes"]
POSE_READINGS: tuple[PoseReading, ...] = ("as given", "inverted", "OpenCV axes", "inverted, OpenCV axes")
_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # device axes of OpenCV <-> of this format
_CLOUD_POINTS = 100  # of a frame, for distances between frames
_FEWEST_POINTS = 10


@dataclass(frozen=True)
class Reading:
    """One way to read a scan. Coordinates are first exchanged, then mirrored."""

    camera: PoseReading = "as given"
    projector: PoseReading = "as given"
    projector_unit: float = 1.0  # factor on the projector's position
    exchanged: bool = False
    mirrored_x: bool = False
    mirrored_y: bool = False


@dataclass(frozen=True)
class ReadingFit:
    """How well a reading fits, frame by frame."""

    residual_px: Float64[ndarray, "n"]  # median epipolar residual; inf: most points lie behind a device
    spread: Float64[ndarray, "n"]  # median distance to the points of other frames, in depths; inf: too few points
    depth: float  # median distance of all points from their cameras; 0: no points
    clouds: tuple[Float64[ndarray, "_ 3"], ...]  # some triangulated points of each frame

    @property
    def typical_px(self) -> float:
        """Median of the frames' residuals."""
        return float(np.median(self.residual_px))

    @property
    def typical_spread(self) -> float:
        """Median of the frames' spreads."""
        return float(np.median(self.spread))


def other_readings() -> Iterator[Reading]:
    """Every known mix-up, the more usual ones first."""
    for both in POSE_READINGS[1:]:
        yield Reading(camera=both, projector=both)
    for camera, projector in product(POSE_READINGS, POSE_READINGS):
        if camera != projector:
            yield Reading(camera=camera, projector=projector)
    for exchanged, x, y in product((False, True), (False, True), (False, True)):
        if exchanged or x or y:
            yield Reading(exchanged=exchanged, mirrored_x=x, mirrored_y=y)
    yield Reading(projector_unit=1e3)
    yield Reading(projector_unit=1e-3)


def apply_reading(reading: Reading, frame: Correspondences, projector: Device) -> Correspondences:
    """The frame with its poses and coordinates read that way, in this format's conventions."""
    T_world_projector = _read_pose(frame.T_world_projector, reading.projector).copy()
    T_world_projector[:3, 3] *= reading.projector_unit
    return replace(
        frame,
        T_world_camera=_read_pose(frame.T_world_camera, reading.camera),
        T_world_projector=T_world_projector,
        uv_projector=_read_coords(frame.uv_projector, reading, projector),
    )


def fit_reading(frames: Sequence[Correspondences], projector: Device) -> ReadingFit:
    """Triangulate all frames and see how well rays meet, and frames agree."""
    camera = Intrinsics.of([f.camera for f in frames], torch.float64).reshape(-1, 1)
    geometry = (
        camera,
        _stack(f.T_world_camera for f in frames)[:, None],
        _stack(f.uv_camera for f in frames),
        Intrinsics.of(projector, torch.float64),
        _stack(f.T_world_projector for f in frames)[:, None],
        _stack(f.uv_projector for f in frames),
    )
    residual = epipolar_residual(*geometry).abs().nan_to_num(nan=torch.inf)
    in_front = residual.isfinite()
    points = triangulate(*geometry)
    depth = float(points.depth_camera[in_front].median()) if in_front.any() else 0.0
    clouds = tuple(_thin(p[ok].numpy()) for p, ok in zip(points.p_world, in_front, strict=True))
    spread = [distance_to_others(cloud, clouds, index) for index, cloud in enumerate(clouds)]
    return ReadingFit(residual.median(-1).values.numpy(), np.array(spread) / max(depth, 1e-300), depth, clouds)


def distance_to_others(cloud: Float64[ndarray, "n 3"], clouds: Sequence[Float64[ndarray, "_ 3"]], index: int) -> float:
    """Median distance from a cloud to the nearest point of any of `clouds` but number `index`; inf if unknown."""
    others = np.concatenate([np.empty((0, 3)), *(c for i, c in enumerate(clouds) if i != index)])
    if len(cloud) < _FEWEST_POINTS or len(others) < _FEWEST_POINTS:
        return np.inf
    return float(np.median(KDTree(others).query(cloud)[0]))


def _thin(cloud: Float64[ndarray, "n 3"]) -> Float64[ndarray, "_ 3"]:
    return cloud[:: max(1, len(cloud) // _CLOUD_POINTS)]


def _read_pose(T: Float64[ndarray, "4 4"], reading: PoseReading) -> Float64[ndarray, "4 4"]:
    out = np.linalg.inv(T) if reading.startswith("inverted") else T
    return out @ _OPENCV if reading.endswith("OpenCV axes") else out


def _read_coords(uv: Float64[ndarray, "n 2"], reading: Reading, projector: Device) -> Float64[ndarray, "n 2"]:
    x, y = uv.T[::-1] if reading.exchanged else uv.T
    return np.stack([projector.w - x if reading.mirrored_x else x, projector.h - y if reading.mirrored_y else y], -1)


def _stack(arrays: Iterator[Float64[ndarray, "..."]]) -> Tensor:
    return torch.from_numpy(np.stack(list(arrays)))
