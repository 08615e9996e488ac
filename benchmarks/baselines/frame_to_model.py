"""Fusion frame to model, as KinectFusion does it (Newcombe et al. 2011), with Open3D's odometry.

Each frame's triangulated depth is tracked against the surface fused so far, seen from where the frame should be, by
projective point-to-plane ICP, coarse to fine, and then fused. KinectFusion begins at the pose of the last frame of a
video. The frames of a scan are too far apart for that (10 to 30 degrees), so each begins at its starting pose. A frame
that sees too little of the surface to be tracked keeps it, and is not fused.
"""

import numpy as np
import open3d as o3d
from jaxtyping import Float
from numpy import ndarray

from benchmarks.baselines.tsdf import UNIT_SIZE, DepthMap, Volume, depth_maps, object_size
from sl_nerfstudio.console import track
from sl_nerfstudio.geometry.devices import Y_Z_DOWN, Device
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.scan import Scan

_GATES = (0.08, 0.03, 0.015)  # of the object's size: depths that differ by more do not correspond; one rendering each
_ITERATIONS = (10, 10, 20)  # of ICP in each rendering, coarse to fine
_FARTHEST = 1e9


def fuse_frame_to_model(scan: Scan, poses: DevicePoses, voxel_share: float = 1 / 250) -> tuple[Mesh, DevicePoses]:
    """The fused surface, and the tracked poses; the first frame stays. Voxels are a share of the object's size."""
    depths = depth_maps(scan, poses)
    volume = Volume(object_size(depths), voxel_share)
    T_world_camera = poses.T_world_camera.copy()
    for i, depth in track(enumerate(depths), "tracking", total=len(depths)):
        tracked = _tracked(volume, depth, T_world_camera[i]) if i else T_world_camera[i]
        if tracked is not None:
            T_world_camera[i] = tracked
            volume.integrate(depth, tracked)
    motions = T_world_camera @ np.linalg.inv(poses.T_world_camera)
    return volume.mesh(), DevicePoses(T_world_camera, motions @ poses.T_world_projector)


def _tracked(volume: Volume, depth: DepthMap, T_world_camera: Float[ndarray, "4 4"]) -> Float[ndarray, "4 4"] | None:
    """The camera's pose against the fused surface, found from `T_world_camera` on; None if it is not determined."""
    odometry = o3d.t.pipelines.odometry
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(volume.surface()))
    matrix, frame = o3d.core.Tensor(_matrix(depth.camera, 0.0)), _image(depth.depth * volume.unit)
    criteria = [odometry.OdometryConvergenceCriteria(n) for n in _ITERATIONS]
    method = odometry.Method.PointToPlane
    T = T_world_camera @ Y_Z_DOWN
    T[:3, 3] *= volume.unit
    for gate in _GATES:
        seen = _image(_seen(scene, depth.camera, T))
        kernel = odometry.OdometryLossParams(gate * UNIT_SIZE, gate * UNIT_SIZE / 3)
        try:
            found = odometry.rgbd_odometry_multi_scale(
                frame, seen, matrix, o3d.core.Tensor(np.eye(4)), 1.0, _FARTHEST, criteria, method, kernel
            )
        except RuntimeError:  # "Singular 6x6 linear system detected, tracking failed."
            return None
        T = T @ found.transformation.numpy()
    T[:3, 3] /= volume.unit
    return T @ Y_Z_DOWN


def _seen(scene: o3d.t.geometry.RaycastingScene, camera: Device, T: Float[ndarray, "4 4"]) -> Float[ndarray, "h w"]:
    """Depth of the surface from a pose in OpenCV's axes; 0 where there is none, or where it is seen from behind."""
    rays = scene.create_rays_pinhole(_matrix(camera, 0.5), np.linalg.inv(T), camera.w, camera.h)
    hit = scene.cast_rays(rays)
    distance, direction = hit["t_hit"].numpy(), rays.numpy()[..., 3:]
    facing = (hit["primitive_normals"].numpy() * direction).sum(-1) < 0
    depth = distance * (direction @ T[:3, 2])
    return np.where(np.isfinite(distance) & facing, depth, 0.0)


def _matrix(camera: Device, first: float) -> Float[ndarray, "3 3"]:
    """Intrinsics with the centre of the first pixel at `first`: Open3D's odometry has it at 0, its rays at 0.5."""
    at = first - 0.5
    return np.array([[camera.fl_x, 0, camera.cx + at], [0, camera.fl_y, camera.cy + at], [0, 0, 1]])


def _image(depth: Float[ndarray, "h w"]) -> o3d.t.geometry.RGBDImage:
    grey = o3d.t.geometry.Image(np.zeros((*depth.shape, 1), np.float32))
    return o3d.t.geometry.RGBDImage(grey, o3d.t.geometry.Image(depth.astype(np.float32)[..., None]))
