"""Triangulated depth maps of frames, for classical fusion."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project
from sl_nerfstudio.geometry.triangulation import pixel_centres, triangulate
from sl_nerfstudio.scan import Frame, Scan

_LEAST_REGION = 0.01  # of the frame's known pixels; smaller islands of depth are wrong decodings
_STEP_PIXELS = 8.0  # neighbours whose depth differs by more than this many pixel footprints are not connected


@dataclass(frozen=True)
class DepthMap:
    """Depth along the camera's axis (not along the ray), 0 where unknown, as an ideal pinhole camera sees it."""

    depth: Float[ndarray, "h w"]
    camera: Device  # without distortion


def triangulated_depth(
    frame: Frame, scan: Scan, T_world_camera: Float[ndarray, "4 4"], T_world_projector: Float[ndarray, "4 4"]
) -> DepthMap:
    """Depth map of one frame from its decoded coordinates; isolated patches are dropped."""
    camera, projector = Intrinsics.of(frame.camera, torch.float64), Intrinsics.of(scan.projector, torch.float64)
    mask, coords = frame.read_mask(), frame.read_coords().astype(np.float64)
    known = mask & np.isfinite(coords).all(-1)
    uv = pixel_centres(frame.camera, torch.float64)[torch.as_tensor(known)]
    T_c, T_p = torch.as_tensor(T_world_camera), torch.as_tensor(T_world_projector)
    meeting = triangulate(camera, T_c, uv, projector, T_p, torch.as_tensor(coords[known]))
    p_camera = (meeting.p_world - T_c[:3, 3]) @ T_c[:3, :3]
    z = -p_camera[:, 2].numpy()
    good = np.isfinite(z) & (z > 0) & (meeting.depth_projector.numpy() > 0)
    depth = np.zeros(known.shape)
    depth[known] = np.where(good, z, 0.0)
    depth = drop_islands(depth, _STEP_PIXELS / frame.camera.fl_x)
    return _undistorted(depth, frame.camera)


def drop_islands(depth: Float[ndarray, "h w"], step: float) -> Float[ndarray, "h w"]:
    """Set small regions to 0; neighbours are connected if their depths differ by less than `step` times depth."""
    h, w = depth.shape
    index = np.arange(h * w).reshape(h, w)
    pairs = [
        _joined(index[:, :-1], index[:, 1:], depth[:, :-1], depth[:, 1:], step),
        _joined(index[:-1], index[1:], depth[:-1], depth[1:], step),
    ]
    a, b = np.concatenate(pairs, 1)
    graph = coo_matrix((np.ones(len(a), bool), (a, b)), shape=(h * w, h * w))
    _, label = connected_components(graph, directed=False)
    large = np.bincount(label)[label].reshape(h, w) >= _LEAST_REGION * (depth > 0).sum()
    return np.where(large, depth, 0.0)


def _joined(a: ndarray, b: ndarray, depth_a: ndarray, depth_b: ndarray, step: float) -> ndarray:
    together: Bool[ndarray, "h w"] = (depth_a > 0) & (depth_b > 0) & (np.abs(depth_a - depth_b) < step * depth_a)
    return np.stack([a[together], b[together]])


def _undistorted(depth: Float[ndarray, "h w"], camera: Device) -> DepthMap:
    """The map as the same camera without distortion would see it (nearest pixel: depths must not be interpolated)."""
    pinhole = Device(camera.w, camera.h, camera.fl_x, camera.fl_y, camera.cx, camera.cy)
    if pinhole == camera:
        return DepthMap(depth, pinhole)
    x, y = ((pixel_centres(camera, torch.float64)[..., k] - c) / f for k, (c, f) in
            enumerate(((camera.cx, camera.fl_x), (camera.cy, camera.fl_y))))  # fmt: skip
    uv, _ = project(Intrinsics.of(camera, torch.float64), torch.stack([x, -y, -torch.ones_like(x)], -1))
    column, row = np.floor(uv.numpy()).astype(np.int64).transpose(2, 0, 1)
    inside = (column >= 0) & (column < camera.w) & (row >= 0) & (row < camera.h)
    out = np.where(inside, depth[np.clip(row, 0, camera.h - 1), np.clip(column, 0, camera.w - 1)], 0.0)
    return DepthMap(out, pinhole)
