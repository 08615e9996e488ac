"""Poses for fusion: registered by ICP as classical pipelines do it, or those with which sl-neus trains."""

import sys
from collections.abc import Sequence

import numpy as np
import open3d as o3d
from jaxtyping import Float
from numpy import ndarray

from benchmarks.baselines.tsdf import UNIT_SIZE, backprojected, depth_maps, object_size
from sl_nerfstudio.bundle_adjustment.search import AdjustmentSettings
from sl_nerfstudio.console import track
from sl_nerfstudio.dataparser.dataparser import load_scan
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.model.pose_refinement import PriorConfig, adjust_scan
from sl_nerfstudio.scan import Scan

_VOXEL = 1 / 80  # lengths relative to the size of the object
_DISTANCES = (0.08, 0.03, 0.015)  # of correspondence, coarse to fine
_NEIGHBOURS = 8  # pairs of a frame: those whose cameras look in the most similar directions
_LEAST_OVERLAP = 0.3  # share of a cloud's points with a partner; pairs with a smaller share are ignored


def register(scan: Scan, poses: DevicePoses, rounds: int = 2) -> DevicePoses:
    """Poses after pairwise point-to-plane ICP and a pose graph over all overlapping pairs."""
    depths = depth_maps(scan, poses)
    unit = UNIT_SIZE / object_size(depths)
    start = poses.T_world_camera.copy()
    start[:, :3, 3] *= unit
    clouds = [
        oriented_cloud(backprojected(d) * unit, T, _VOXEL * UNIT_SIZE) for d, T in zip(depths, start, strict=True)
    ]
    motion = np.tile(np.eye(4), (len(clouds), 1, 1))
    for distances in (_DISTANCES, *[_DISTANCES[1:]] * (rounds - 1)):
        moved = [o3d.geometry.PointCloud(c).transform(T) for c, T in zip(clouds, motion, strict=True)]
        step = _multiway(moved, motion @ start, [d * UNIT_SIZE for d in distances])
        motion = step @ motion
    motion[:, :3, 3] /= unit
    return DevicePoses(motion @ poses.T_world_camera, motion @ poses.T_world_projector)


def oriented_cloud(p_camera: Float[ndarray, "n 3"], T: Float[ndarray, "4 4"], voxel: float) -> o3d.geometry.PointCloud:
    """Points in world axes, one for each voxel, without stray ones, with normals towards the camera at `T`."""
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(p_camera @ T[:3, :3].T + T[:3, 3]))
    cloud = cloud.voxel_down_sample(voxel)
    cloud, _ = cloud.remove_statistical_outlier(20, 2.0)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=4 * voxel, max_nn=30))
    cloud.orient_normals_towards_camera_location(T[:3, 3])
    return cloud


def _multiway(
    clouds: Sequence[o3d.geometry.PointCloud], T_world_camera: Float[ndarray, "n 4 4"], distances: Sequence[float]
) -> Float[ndarray, "n 4 4"]:
    """Motion of each cloud; the first one stays."""
    registration = o3d.pipelines.registration
    graph = registration.PoseGraph()
    for _ in clouds:
        graph.nodes.append(registration.PoseGraphNode(np.eye(4)))
    pairs = _pairs(T_world_camera)
    for i, j in track(pairs, "registering pairs"):
        edge = _pair(clouds[i], clouds[j], distances)
        if edge is not None:
            graph.edges.append(registration.PoseGraphEdge(i, j, edge[0], edge[1], uncertain=abs(i - j) != 1))
    option = registration.GlobalOptimizationOption(
        max_correspondence_distance=distances[-1], edge_prune_threshold=0.25, preference_loop_closure=1.0,
        reference_node=0,
    )  # fmt: skip
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        registration.global_optimization(
            graph, registration.GlobalOptimizationLevenbergMarquardt(),
            registration.GlobalOptimizationConvergenceCriteria(), option,
        )  # fmt: skip
    return np.stack([node.pose for node in graph.nodes])


def _pairs(T_world_camera: Float[ndarray, "n 4 4"]) -> list[tuple[int, int]]:
    """Frames to register with each other: each with its successor and with those that look in similar directions."""
    looking = -T_world_camera[:, :3, 2]
    alike = looking @ looking.T
    pairs = {(i, i + 1) for i in range(len(looking) - 1)}
    for i, row in enumerate(alike):
        for j in np.argsort(-row)[: _NEIGHBOURS + 1]:
            if i != j:
                pairs.add((min(i, int(j)), max(i, int(j))))
    return sorted(pairs)


def _pair(
    source: o3d.geometry.PointCloud, target: o3d.geometry.PointCloud, distances: Sequence[float]
) -> tuple[Float[ndarray, "4 4"], Float[ndarray, "6 6"]] | None:
    """Motion of `source` onto `target` and its information matrix; None if they overlap too little."""
    registration = o3d.pipelines.registration
    T = np.eye(4)
    fitness = 0.0
    for distance in distances:
        kernel = registration.TukeyLoss(k=distance)
        found = registration.registration_icp(
            source, target, distance, T, registration.TransformationEstimationPointToPlane(kernel)
        )
        T, fitness = np.asarray(found.transformation), found.fitness
    if fitness < _LEAST_OVERLAP:
        return None
    information = registration.get_information_matrix_from_point_clouds(source, target, distances[-1], T)
    return T, np.asarray(information)


def refined_poses(scan: Scan) -> DevicePoses:
    """Poses after our joint adjustment, with its defaults, in the scan's gauge."""
    loaded = load_scan(scan.root)
    found = adjust_scan(scan, loaded.S_scene_world, loaded.samples, "free", PriorConfig(), AdjustmentSettings())
    if not found.adjusted:
        print(f"{scan.root.name}: adjusted poses were not better on held-out pixels, and are not used", file=sys.stderr)
    return found.rig.poses(loaded.S_scene_world.inverse())
