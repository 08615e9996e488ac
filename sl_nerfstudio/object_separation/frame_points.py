"""Triangulated points of decoded frames, with their measured noise."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64
from numpy import ndarray
from scipy.spatial import KDTree

from sl_nerfstudio.geometry.devices import Device, Intrinsics
from sl_nerfstudio.geometry.epipolar import epipolar_residual
from sl_nerfstudio.geometry.robust import MAD_TO_SIGMA
from sl_nerfstudio.geometry.triangulation import triangulate

LEAST_COSINE = 0.05  # between a ray and a plane's normal: a ray in the plane would have no noise across it
_LEAST_NOISE_PX = 0.01  # rounding of stored coordinates and poses
_SAME_PLACE = 3.0  # spacings: how far apart points of two frames on the same surface may be
_SAME_NORMAL = 0.9  # cosine


@dataclass(frozen=True)
class DecodedFrame:
    """The decoded coordinates of one frame, at every `stride`-th pixel, with both devices in the world."""

    camera: Device
    projector: Device
    T_world_camera: Float64[ndarray, "4 4"]
    T_world_projector: Float64[ndarray, "4 4"]
    coords: Float32[ndarray, "h w 2"]  # NaN where not decoded
    seen: Bool[ndarray, "h w"]  # where the pattern was seen, decoded or not
    stride: int = 1

    def thinned(self, most: int) -> "DecodedFrame":
        """Every n-th pixel, so that at most about `most` are decoded."""
        count = int(np.isfinite(self.coords).all(-1).sum())
        step = max(1, int(np.ceil(np.sqrt(count / most))))
        coords, seen = self.coords[::step, ::step].copy(), self.seen[::step, ::step].copy()
        return replace(self, coords=coords, seen=seen, stride=step * self.stride)


@dataclass(frozen=True)
class FramePoints:
    """The surface points of one frame."""

    row: Int64[ndarray, "n"]  # of the thinned frame
    column: Int64[ndarray, "n"]
    p_world: Float64[ndarray, "n 3"]
    ray: Float64[ndarray, "n 3"]  # unit direction from the camera
    sigma: Float64[ndarray, "n"]  # 1 sigma along the ray

    def __len__(self) -> int:
        """Number of points."""
        return len(self.p_world)

    def chosen(self, index: Int64[ndarray, "m"] | Bool[ndarray, "n"]) -> "FramePoints":
        """Some of the points."""
        return FramePoints(*(values[index] for values in vars(self).values()))

    def scaled_noise(self, factor: float) -> "FramePoints":
        """With all sigmas multiplied."""
        return replace(self, sigma=self.sigma * factor)

    def sigma_along(self, normal: Float[ndarray, "3"] | Float[ndarray, "n 3"]) -> Float64[ndarray, "n"]:
        """1 sigma of each point's place along a direction."""
        return self.sigma * np.abs((self.ray * normal).sum(-1)).clip(LEAST_COSINE)


def points_of(frame: DecodedFrame) -> FramePoints:
    """Triangulate a frame; pixels whose rays meet behind a device, or nowhere, have no point.

    The noise of the coordinates is measured: the robust standard deviation of the epipolar residual.
    """
    row, column = np.nonzero(np.isfinite(frame.coords).all(-1))
    uv = torch.from_numpy(np.stack([column, row], -1) * float(frame.stride) + 0.5)
    pair = (
        Intrinsics.of(frame.camera, torch.float64), torch.from_numpy(frame.T_world_camera), uv,
        Intrinsics.of(frame.projector, torch.float64), torch.from_numpy(frame.T_world_projector),
        torch.from_numpy(frame.coords[row, column].astype(np.float64)),
    )  # fmt: skip
    found = triangulate(*pair)
    residual = epipolar_residual(*pair).numpy()
    origin = frame.T_world_camera[:3, 3]
    p = found.p_world.numpy()
    good = np.isfinite(residual) & np.isfinite(p).all(-1)
    noise = MAD_TO_SIGMA * float(np.median(np.abs(residual[good]))) if good.any() else 0.0
    ray = p[good] - origin
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    sigma = found.sigma_depth.numpy()[good] * max(noise, _LEAST_NOISE_PX)
    return FramePoints(row[good].astype(np.int64), column[good].astype(np.int64), p[good], ray, sigma)


def normals_of(points: FramePoints, neighbours: int) -> Float64[ndarray, "n 3"]:
    """Unit normals towards the camera, from the nearest points of the same frame; NaN with too few points."""
    if len(points) < neighbours:
        return np.full((len(points), 3), np.nan)
    _, near = KDTree(points.p_world).query(points.p_world, neighbours)
    offset = points.p_world[near] - points.p_world[near].mean(1, keepdims=True)
    _, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", offset, offset))
    normal = vectors[:, :, 0]
    return normal * -np.sign((normal * points.ray).sum(-1, keepdims=True))


def cross_frame_noise(frames: Sequence[FramePoints], normals: Sequence[Float[ndarray, "_n 3"]]) -> float:
    """How much farther points of different frames are from each other than their own noise explains; at least 1.

    Every frame is compared with some others, one by one: each point with the tangent plane at the nearest point there.
    What exceeds the noise of coordinates is error of the poses.
    """
    count = len(frames)
    ratios = [
        _distances_in_sigmas(frames[k], normals[k], frames[other], normals[other])
        for k in range(count)
        for other in sorted({(k + step) % count for step in (1, 2, count // 3, count // 2)} - {k})
    ]
    ratio = np.concatenate([np.zeros(0), *ratios])
    return max(1.0, MAD_TO_SIGMA * float(np.median(ratio))) if len(ratio) else 1.0


def _distances_in_sigmas(
    a: FramePoints, normal_a: Float[ndarray, "n 3"], b: FramePoints, normal_b: Float[ndarray, "m 3"]
) -> Float64[ndarray, "k"]:
    """Distances of points of one frame from tangent planes of another, where both show the same surface."""
    if min(len(a), len(b)) < 2:
        return np.zeros(0)
    tree = KDTree(b.p_world)
    spacing = float(np.median(np.asarray(tree.query(b.p_world, 2)[0])[:, 1]))
    distance, near = (np.asarray(v) for v in tree.query(a.p_world, distance_upper_bound=_SAME_PLACE * spacing))
    mine = np.flatnonzero(np.isfinite(distance))
    there = near[mine]
    same = (normal_a[mine] * normal_b[there]).sum(-1) > _SAME_NORMAL
    mine, there = mine[same], there[same]
    off = ((a.p_world[mine] - b.p_world[there]) * normal_b[there]).sum(-1)
    sigma = np.hypot(a.sigma_along(normal_a)[mine], b.sigma_along(normal_b)[there])
    return np.abs(off) / sigma
