"""Poisson's surface of triangulated points (Kazhdan and Hoppe 2013, as Open3D has it)."""

import numpy as np
import open3d as o3d
from scipy.spatial import KDTree

from benchmarks.baselines.poses import oriented_cloud
from benchmarks.baselines.tsdf import UNIT_SIZE, backprojected, depth_maps, largest_pieces, object_size
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.scan import Scan

_VOXEL = 1 / 250  # of the object's size: one point each, as fusion's voxels
_DEPTH = 9  # of Poisson's octree
_FARTHEST_VOXELS = 4.0  # from the points: Poisson's surface beyond was closed, not measured


def poisson(scan: Scan, poses: DevicePoses) -> Mesh:
    """Poisson's surface (Open3D) of the triangulated points of all frames, where there are points."""
    depths = depth_maps(scan, poses)
    unit, voxel = UNIT_SIZE / object_size(depths), _VOXEL * UNIT_SIZE
    cloud = o3d.geometry.PointCloud()
    for depth, T in zip(depths, poses.T_world_camera, strict=True):
        scaled = T.copy()
        scaled[:3, 3] *= unit
        cloud += oriented_cloud(backprojected(depth) * unit, scaled, voxel)
    mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=_DEPTH, n_threads=1)
    far = KDTree(np.asarray(cloud.points)).query(np.asarray(mesh.vertices))[0] > _FARTHEST_VOXELS * voxel
    mesh.remove_vertices_by_mask(far)
    return largest_pieces(mesh, unit)
