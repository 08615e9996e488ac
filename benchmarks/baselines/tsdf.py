"""Classical fusion for comparison: triangulate each frame, then fuse into a truncated signed distance (Open3D)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import open3d as o3d
from jaxtyping import Float
from numpy import ndarray

from benchmarks.baselines.depth import DepthMap, triangulated_depth
from sl_nerfstudio.console import track
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.scan import Scan

_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # nerfstudio's camera axes to OpenCV's, on the right
_UNIT_SIZE = 100.0  # the object is scaled to about this size: Open3D's defaults assume it


@dataclass(frozen=True)
class TsdfConfig:
    """Settings of the fusion, relative to the size of the object."""

    voxel: float = 1 / 250  # of the object's size
    truncation_voxels: float = 5.0
    least_component: float = 0.02  # of the largest connected piece's triangles; smaller pieces are dropped


def fuse(scan: Scan, poses: DevicePoses, config: TsdfConfig | None = None) -> Mesh:
    """TSDF fusion of the scan's triangulated depth maps with the given poses; world units and axes."""
    config = config or TsdfConfig()
    depths = depth_maps(scan, poses)
    size = object_size(depths)
    unit = _UNIT_SIZE / size
    voxel = config.voxel * _UNIT_SIZE
    volume = o3d.pipelines.integration.ScalableTSDFVolume(
        voxel_length=voxel,
        sdf_trunc=config.truncation_voxels * voxel,
        color_type=o3d.pipelines.integration.TSDFVolumeColorType.NoColor,
    )
    for depth, T in track(zip(depths, poses.T_world_camera, strict=True), "fusing", total=len(depths)):
        camera = depth.camera
        intrinsic = o3d.camera.PinholeCameraIntrinsic(
            camera.w, camera.h, camera.fl_x, camera.fl_y, camera.cx - 0.5, camera.cy - 0.5
        )
        scaled = T.copy()
        scaled[:3, 3] *= unit
        image = o3d.geometry.Image((depth.depth * unit).astype(np.float32))
        grey = o3d.geometry.Image(np.zeros(depth.depth.shape, np.uint8))
        rgbd = o3d.geometry.RGBDImage.create_from_color_and_depth(
            grey, image, depth_scale=1.0, depth_trunc=1e9, convert_rgb_to_intensity=False
        )
        volume.integrate(rgbd, intrinsic, np.linalg.inv(scaled @ _OPENCV))
    return _largest_pieces(volume.extract_triangle_mesh(), config.least_component, unit)


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


def _largest_pieces(mesh: o3d.geometry.TriangleMesh, least: float, unit: float) -> Mesh:
    piece, count, _ = mesh.cluster_connected_triangles()
    piece, count = np.asarray(piece), np.asarray(count)
    whole = Mesh(np.asarray(mesh.vertices) / unit, np.asarray(mesh.triangles).astype(np.int64))
    return whole.with_faces(count[piece] >= least * count.max()) if len(piece) else whole
