"""Classical fusion for comparison: triangulate each frame, then fuse into a truncated signed distance (Open3D)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import open3d as o3d
import torch
from jaxtyping import Bool, Float
from numpy import ndarray

from sl_nerfstudio.console import track
from sl_nerfstudio.geometry.devices import Y_Z_DOWN, Device, Intrinsics, project
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.geometry.numerics import component_labels
from sl_nerfstudio.geometry.triangulation import pixel_centres, triangulate
from sl_nerfstudio.meshing.mesh import Mesh
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
    label = component_labels(a, b, h * w)
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


_TRUNCATION_VOXELS = 5.0
_LEAST_PIECE = 0.02  # of the largest connected piece's triangles; smaller pieces are dropped
UNIT_SIZE = 100.0  # the object is scaled to about this size: Open3D's defaults assume it


class Volume:
    """A truncated signed distance, of an object that is scaled to `UNIT_SIZE`."""

    def __init__(self, size: float, voxel_share: float) -> None:
        """`size` of the object, in the world's unit. Voxels are a share of it."""
        self.unit = UNIT_SIZE / size
        voxel = voxel_share * UNIT_SIZE
        self._tsdf = o3d.pipelines.integration.ScalableTSDFVolume(
            voxel_length=voxel,
            sdf_trunc=_TRUNCATION_VOXELS * voxel,
            color_type=o3d.pipelines.integration.TSDFVolumeColorType.NoColor,
        )

    def integrate(self, depth: DepthMap, T_world_camera: Float[ndarray, "4 4"]) -> None:
        """Add a depth map."""
        camera = depth.camera
        intrinsic = o3d.camera.PinholeCameraIntrinsic(
            camera.w, camera.h, camera.fl_x, camera.fl_y, camera.cx - 0.5, camera.cy - 0.5
        )
        scaled = T_world_camera.copy()
        scaled[:3, 3] *= self.unit
        image = o3d.geometry.Image((depth.depth * self.unit).astype(np.float32))
        grey = o3d.geometry.Image(np.zeros(depth.depth.shape, np.uint8))
        rgbd = o3d.geometry.RGBDImage.create_from_color_and_depth(
            grey, image, depth_scale=1.0, depth_trunc=1e9, convert_rgb_to_intensity=False
        )
        self._tsdf.integrate(rgbd, intrinsic, np.linalg.inv(scaled @ Y_Z_DOWN))

    def surface(self) -> o3d.geometry.TriangleMesh:
        """All of the surface, scaled."""
        return self._tsdf.extract_triangle_mesh()

    def mesh(self) -> Mesh:
        """The surface without small pieces, in the world's unit."""
        return largest_pieces(self.surface(), self.unit)


def fuse(scan: Scan, poses: DevicePoses, voxel_share: float = 1 / 250) -> Mesh:
    """TSDF fusion of the scan's triangulated depth maps; world units and axes. Voxels are a share of the object."""
    depths = depth_maps(scan, poses)
    volume = Volume(object_size(depths), voxel_share)
    for depth, T in track(zip(depths, poses.T_world_camera, strict=True), "fusing", total=len(depths)):
        volume.integrate(depth, T)
    return volume.mesh()


def depth_maps(scan: Scan, poses: DevicePoses) -> list[DepthMap]:
    """Triangulated depth of every frame."""
    work = zip(scan.frames, poses.T_world_camera, poses.T_world_projector, strict=True)
    return [
        triangulated_depth(f, scan, T_c, T_p) for f, T_c, T_p in track(work, "triangulating", total=len(scan.frames))
    ]


def object_size(depths: Sequence[DepthMap]) -> float:
    """Rough extent of the object: that of the widest depth map, between its 2nd and 98th percentile."""
    return max((_extent(depth) for depth in depths), default=0.0)


def _extent(depth: DepthMap) -> float:
    points = backprojected(depth)
    return float(np.linalg.norm(np.ptp(np.percentile(points, [2, 98], axis=0), axis=0))) if len(points) else 0.0


def backprojected(depth: DepthMap) -> Float[ndarray, "n 3"]:
    """Points of a depth map in the camera's axes (looking along -z)."""
    row, column = np.nonzero(depth.depth)
    z, camera = depth.depth[row, column], depth.camera
    x, y = (column + 0.5 - camera.cx) / camera.fl_x, (row + 0.5 - camera.cy) / camera.fl_y
    return np.stack([x * z, -y * z, -z], 1)


def largest_pieces(mesh: o3d.geometry.TriangleMesh, unit: float) -> Mesh:
    """A mesh without small pieces, its lengths divided by `unit`."""
    piece, count, _ = mesh.cluster_connected_triangles()
    piece, count = np.asarray(piece), np.asarray(count)
    whole = Mesh(np.asarray(mesh.vertices) / unit, np.asarray(mesh.triangles).astype(np.int64))
    return whole.with_faces(count[piece] >= _LEAST_PIECE * count.max()) if len(piece) else whole
