"""Geometry that sl-check judges: how well the rays of a scan's frames meet, and how well their surfaces agree."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray
from scipy.spatial import KDTree
from torch import Tensor

from sl_nerfstudio.geometry.devices import Device, Intrinsics
from sl_nerfstudio.geometry.numerics import evenly_spaced
from sl_nerfstudio.geometry.triangulation import epipolar_residual, triangulate
from sl_nerfstudio.scan.types import PoseSigma

# A few hundred correspondences of each frame, kept while the frames are read one by one.

SAMPLES = 400  # per frame; enough for a median, few enough to try dozens of interpretations


@dataclass(frozen=True)
class Correspondences:
    """Camera pixels and pattern coordinates of one frame, with everything needed to triangulate them."""

    name: str
    camera: Device
    T_world_camera: Float64[ndarray, "4 4"]
    T_world_projector: Float64[ndarray, "4 4"]
    uv_camera: Float64[ndarray, "n 2"]
    uv_projector: Float64[ndarray, "n 2"]
    sigma: PoseSigma | None = None  # what the scan states of the two poses


def sample_pixels(
    coords: Float32[ndarray, "h w 2"], where: Bool[ndarray, "h w"]
) -> tuple[Float64[ndarray, "n 2"], Float64[ndarray, "n 2"]]:
    """Pixel centres and coordinates at SAMPLES pixels spread evenly over `where` (some twice if it has fewer)."""
    flat = np.flatnonzero(where)
    chosen = flat[evenly_spaced(len(flat), SAMPLES)]
    rows, columns = np.divmod(chosen, where.shape[1])
    return np.stack([columns, rows], -1) + 0.5, coords.reshape(-1, 2)[chosen].astype(np.float64)


# How far a frame's points are from those of all other frames, in one search tree.

_FEWEST_POINTS = 10


class OtherClouds:
    """Point clouds of frames, to be searched without the cloud of one frame."""

    def __init__(self, clouds: Sequence[Float64[ndarray, "_ 3"]]) -> None:
        """`clouds` are numbered in their order."""
        self._sizes = [len(cloud) for cloud in clouds]
        self._number = np.repeat(np.arange(len(clouds)), self._sizes)
        self._tree = KDTree(np.concatenate([np.empty((0, 3)), *clouds]))

    def distance(self, cloud: Float64[ndarray, "n 3"], index: int) -> float:
        """Median distance from the points of `cloud` to the nearest one of any cloud but number `index`.

        Infinite where either side has too few points.
        """
        own = self._sizes[index]
        if len(cloud) < _FEWEST_POINTS or self._tree.n - own < _FEWEST_POINTS:
            return np.inf
        distances, points = self._tree.query(cloud, k=own + 2)  # not all of these are of cloud `index`
        first = (self._number[points] != index).argmax(1)
        return float(np.median(distances[np.arange(len(cloud)), first]))


# Rays and surfaces under the poses of a scan.

_CLOUD_POINTS = 100  # of a frame, for distances between frames
_FEWEST_CLOUD_POINTS = 20  # the same in a scan of very many frames
_MOST_POINTS = 200_000  # of all frames together
_LOOK_UP = 0.5  # error that no decoder and no calibration is assumed to be free of, 1 sigma, in camera pixels


@dataclass(frozen=True)
class GeometricFit:
    """Fit of rays and frames under one interpretation, frame by frame."""

    residual_px: Float64[ndarray, "n"]  # median epipolar residual; inf: most points are behind a device
    spread: Float64[ndarray, "n"]  # median distance to the points of other frames, in depths; inf: too few points
    depth: float  # median distance of all points from their cameras; 0: no points
    clouds: tuple[Float64[ndarray, "_ 3"], ...]  # some triangulated points of each frame
    stated_px: Float64[ndarray, "n"]  # residual by 1 sigma of what is stated of the relative pose; NaN: not stated

    @property
    def typical_px(self) -> float:
        """Median of the frames' residuals."""
        return float(np.median(self.residual_px))

    @property
    def typical_spread(self) -> float:
        """Median of the frames' spreads."""
        return float(np.median(self.spread))

    @property
    def typical_excess(self) -> float:
        """Median of the residuals in units of what is stated, of frames for which something is; NaN without any."""
        excess = (self.residual_px / self.stated_px)[np.isfinite(self.stated_px)]
        return float(np.median(excess)) if len(excess) else np.nan


def geometry_of(
    frames: Sequence[Correspondences], projector: Device
) -> tuple[Intrinsics, Tensor, Tensor, Intrinsics, Tensor, Tensor]:
    """Devices, poses and pixels as `triangulate` takes them, [frames, points]."""
    return (
        Intrinsics.of([f.camera for f in frames], torch.float64).reshape(-1, 1),
        _stack(f.T_world_camera for f in frames)[:, None],
        _stack(f.uv_camera for f in frames),
        Intrinsics.of(projector, torch.float64),
        _stack(f.T_world_projector for f in frames)[:, None],
        _stack(f.uv_projector for f in frames),
    )


def fit_geometry(frames: Sequence[Correspondences], projector: Device) -> GeometricFit:
    """Triangulate all frames; measure how well rays meet and how well frames agree."""
    geometry = geometry_of(frames, projector)
    residual = epipolar_residual(*geometry).abs().nan_to_num(nan=torch.inf)
    in_front = residual.isfinite()
    points = triangulate(*geometry)
    depth = float(points.depth_camera[in_front].median()) if in_front.any() else 0.0
    count = max(_FEWEST_CLOUD_POINTS, min(_CLOUD_POINTS, _MOST_POINTS // len(frames)))
    seen = [p[ok].numpy() for p, ok in zip(points.p_world, in_front, strict=True)]
    clouds = tuple(cloud[:: max(1, len(cloud) // count)] for cloud in seen)
    others = OtherClouds(clouds)
    spread = [others.distance(cloud, index) for index, cloud in enumerate(clouds)]
    return GeometricFit(
        residual.median(-1).values.numpy(),
        np.array(spread) / max(depth, 1e-300),
        depth,
        clouds,
        np.array([_stated_px(frame, projector, depth) for frame in frames]),
    )


def _stated_px(frame: Correspondences, projector: Device, depth: float) -> float:
    """Epipolar residual that the stated uncertainty of a relative pose and of a look-up explain, 1 sigma."""
    if frame.sigma is None or depth <= 0:
        return np.nan
    camera = (frame.camera.fl_x + frame.camera.fl_y) / 2
    of_poses = np.hypot(np.radians(frame.sigma.relative_rotation_deg), frame.sigma.relative_translation / depth)
    return (projector.fl_x + projector.fl_y) / 2 * float(np.hypot(of_poses, _LOOK_UP / camera))


def _stack(arrays: Iterator[Float64[ndarray, "..."]]) -> Tensor:
    return torch.from_numpy(np.stack(list(arrays)))
