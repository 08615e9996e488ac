"""Other conventions that poses and coordinates may follow by mistake, and how well each of them fits."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float64
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.geometry.devices import Device, Intrinsics
from sl_nerfstudio.geometry.epipolar import epipolar_residual
from sl_nerfstudio.geometry.triangulation import triangulate
from sl_nerfstudio.scan.check.correspondences import Correspondences
from sl_nerfstudio.scan.check.other_clouds import OtherClouds

PoseConvention = Literal["as given", "inverted", "OpenCV axes", "inverted, OpenCV axes"]
POSE_CONVENTIONS: tuple[PoseConvention, ...] = ("as given", "inverted", "OpenCV axes", "inverted, OpenCV axes")
_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # device axes of OpenCV <-> of this format
_CLOUD_POINTS = 100  # of a frame, for distances between frames
_FEWEST_CLOUD_POINTS = 20  # the same in a scan of very many frames
_MOST_POINTS = 200_000  # of all frames together


@dataclass(frozen=True)
class Interpretation:
    """One way to interpret a scan. Coordinates are first swapped, then mirrored."""

    camera: PoseConvention = "as given"
    projector: PoseConvention = "as given"
    projector_unit: float = 1.0  # factor on the projector's position
    swapped: bool = False
    mirrored_x: bool = False
    mirrored_y: bool = False


@dataclass(frozen=True)
class GeometricFit:
    """How well rays meet and frames agree under one interpretation, frame by frame."""

    residual_px: Float64[ndarray, "n"]  # median epipolar residual; inf: most points are behind a device
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


def other_interpretations() -> Iterator[Interpretation]:
    """Every known mistake, the more common ones first."""
    for both in POSE_CONVENTIONS[1:]:
        yield Interpretation(camera=both, projector=both)
    for camera, projector in product(POSE_CONVENTIONS, POSE_CONVENTIONS):
        if camera != projector:
            yield Interpretation(camera=camera, projector=projector)
    for swapped, x, y in product((False, True), (False, True), (False, True)):
        if swapped or x or y:
            yield Interpretation(swapped=swapped, mirrored_x=x, mirrored_y=y)
    yield Interpretation(projector_unit=1e3)
    yield Interpretation(projector_unit=1e-3)


def apply_interpretation(interpretation: Interpretation, frame: Correspondences, projector: Device) -> Correspondences:
    """The frame with its poses and coordinates interpreted that way, in the conventions of this format."""
    T_world_projector = _converted_pose(frame.T_world_projector, interpretation.projector).copy()
    T_world_projector[:3, 3] *= interpretation.projector_unit
    return replace(
        frame,
        T_world_camera=_converted_pose(frame.T_world_camera, interpretation.camera),
        T_world_projector=T_world_projector,
        uv_projector=_converted_coords(frame.uv_projector, interpretation, projector),
    )


def fit_geometry(frames: Sequence[Correspondences], projector: Device) -> GeometricFit:
    """Triangulate all frames; measure how well rays meet and how well frames agree."""
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
    count = max(_FEWEST_CLOUD_POINTS, min(_CLOUD_POINTS, _MOST_POINTS // len(frames)))
    clouds = tuple(_thin(p[ok].numpy(), count) for p, ok in zip(points.p_world, in_front, strict=True))
    others = OtherClouds(clouds)
    spread = [others.distance(cloud, index) for index, cloud in enumerate(clouds)]
    return GeometricFit(residual.median(-1).values.numpy(), np.array(spread) / max(depth, 1e-300), depth, clouds)


def _thin(cloud: Float64[ndarray, "n 3"], count: int) -> Float64[ndarray, "_ 3"]:
    return cloud[:: max(1, len(cloud) // count)]


def _converted_pose(T: Float64[ndarray, "4 4"], convention: PoseConvention) -> Float64[ndarray, "4 4"]:
    out = np.linalg.inv(T) if convention.startswith("inverted") else T
    return out @ _OPENCV if convention.endswith("OpenCV axes") else out


def _converted_coords(uv: Float64[ndarray, "n 2"], how: Interpretation, projector: Device) -> Float64[ndarray, "n 2"]:
    x, y = uv.T[::-1] if how.swapped else uv.T
    return np.stack([projector.w - x if how.mirrored_x else x, projector.h - y if how.mirrored_y else y], -1)


def _stack(arrays: Iterator[Float64[ndarray, "..."]]) -> Tensor:
    return torch.from_numpy(np.stack(list(arrays)))
