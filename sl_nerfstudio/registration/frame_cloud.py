"""The surface of one frame in camera axes, in units of its own baseline, with the uncertainty of every point."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device, Intrinsics
from sl_nerfstudio.geometry.triangulation import triangulate
from sl_nerfstudio.registration.settings import FRAME_CLOUD_DEFAULTS, REGISTRATION_DEFAULTS, FrameCloudSettings
from sl_nerfstudio.relative_pose.agreement import agreeing_coords
from sl_nerfstudio.relative_pose.camera_depth import camera_depth_by_pose
from sl_nerfstudio.relative_pose.estimation import RelativePose, RelativePoseError
from sl_nerfstudio.relative_pose.ray_pairs import correspondences_of, directions


@dataclass(frozen=True)
class FrameCloud:
    """Points of one frame in camera axes (looking along -z), baseline one, and the maps they come from."""

    name: str
    camera: Device
    projector: Device
    pose: RelativePose
    coords: Float32[ndarray, "h w 2"]  # decoded coordinates that agree with the pose; NaN elsewhere
    uv_camera: Float64[ndarray, "n 2"]  # of the points: `correspondences_of(coords)`
    points: Float64[ndarray, "n 3"]
    sigma_noise: Float64[ndarray, "n"]  # along the camera ray, from decoding noise: independent of other cells
    pose_errors: Float64[ndarray, "n 5"]  # along the camera ray, by one sigma of each principal error of the pose
    light: Float32[ndarray, "h w"] | None = None  # of the projector that each pixel returns; None: not measured
    seen: Bool[ndarray, "h w"] | None = None  # where the camera saw the pattern, decoded or not; None: not known
    alternatives: tuple["FrameCloud", ...] = ()  # with other poses that explain the coordinates nearly as well

    def with_pose(self, projector: Device, pose: RelativePose) -> "FrameCloud":
        """The same coordinates with another projector, or another pose of it. Raises as `frame_cloud` does."""
        return frame_cloud(self.name, self.coords, self.camera, projector, pose, light=self.light, seen=self.seen)

    @property
    def sigma(self) -> Float64[ndarray, "n"]:
        """One standard deviation along the camera ray, without that of the unknown length of the baseline."""
        return np.hypot(self.sigma_noise, self.sigma_pose)

    @property
    def sigma_pose(self) -> Float64[ndarray, "n"]:
        """Along the camera ray, from the pose's covariance: points err together."""
        return np.linalg.norm(self.pose_errors, axis=1)

    @property
    def centroid(self) -> Float64[ndarray, "3"]:
        """Mean of the points."""
        return self.points.mean(0)

    @property
    def radius(self) -> float:
        """Root mean square distance of the points from their mean."""
        return float(np.sqrt(((self.points - self.centroid) ** 2).sum(-1).mean()))


def frame_cloud(
    name: str,
    coords: Float32[ndarray, "h w 2"],
    camera: Device,
    projector: Device,
    pose: RelativePose,
    settings: FrameCloudSettings = FRAME_CLOUD_DEFAULTS,
    light: Float32[ndarray, "h w"] | None = None,
    seen: Bool[ndarray, "h w"] | None = None,
) -> FrameCloud:
    """Triangulate one frame, with each pose that explains it. `coords` are those from which `pose` was found.

    `light` is how much of the projector's light each pixel returns, NaN where that is unknown;
    `seen` is where the camera saw the pattern.

    Raises RelativePoseError where hardly any point agrees with the pose.
    """
    uv_camera, uv_projector = correspondences_of(coords)
    keep = pose.inliers
    if keep.sum() < settings.fewest_points:
        raise RelativePoseError(
            f"{name}: only {keep.sum()} points agree with the projector's pose (at least {settings.fewest_points})\n"
            "    cause:  too little of the pattern was decoded\n"
            "    remedy: capture this view again"
        )
    T = torch.from_numpy(pose.T_camera_projector)
    found = triangulate(
        Intrinsics.of(camera, torch.float64),
        torch.eye(4, dtype=torch.float64),
        torch.from_numpy(uv_camera[keep]),
        Intrinsics.of(projector, torch.float64),
        T,
        torch.from_numpy(uv_projector[keep]),
    )
    # On the camera ray, not midway between both rays: camera pixels are exact, coordinates are not.
    points = directions(camera, uv_camera[keep]) * found.depth_camera.numpy()[:, None]
    return FrameCloud(
        name,
        camera,
        projector,
        pose,
        agreeing_coords(coords, camera, projector, pose),
        uv_camera[keep],
        points,
        sigma_noise=pose.noise_px[keep] * found.sigma_depth.numpy(),
        pose_errors=_pose_errors(uv_camera[keep], uv_projector[keep], camera, projector, pose),
        light=light,
        seen=seen,
        alternatives=tuple(
            frame_cloud(name, coords, camera, projector, other, settings, light, seen)
            for other in pose.alternatives
            if other.inliers.sum() >= settings.fewest_points
        ),
    )


def _pose_errors(
    uv_camera: Float[ndarray, "n 2"],
    uv_projector: Float[ndarray, "n 2"],
    camera: Device,
    projector: Device,
    pose: RelativePose,
) -> Float64[ndarray, "n 5"]:
    """Changes of depth by one sigma of the pose along each principal axis of its covariance."""
    R, t = pose.T_camera_projector[:3, :3], pose.T_camera_projector[:3, 3]
    slopes = camera_depth_by_pose(R, t, directions(camera, uv_camera), directions(projector, uv_projector))
    variance, axes = np.linalg.eigh(pose.covariance)
    return slopes @ (axes * np.sqrt(variance.clip(0)))


def motion_by_pose_errors(cloud: FrameCloud) -> Float64[ndarray, "7 5"]:
    """What one sigma of each principal error of the pose mostly amounts to: a similarity of the whole surface.

    Increments (v, w, l) about the centroid: `p <- c + exp(l) exp(w) (p - c) + v`, lengths in baselines.
    """
    some = slice(None, None, max(1, len(cloud.points) // 500))
    points = cloud.points[some]
    ray = points / np.linalg.norm(points, axis=1, keepdims=True)
    moved = ray[:, :, None] * cloud.pose_errors[some, None, :]
    p = points - cloud.centroid
    turns = np.cross(np.eye(3), p[:, None, :]).transpose(0, 2, 1)  # columns e_k x p
    similarity = np.concatenate([np.broadcast_to(np.eye(3), turns.shape), turns, p[:, :, None]], 2)
    return np.linalg.lstsq(similarity.reshape(-1, 7), moved.reshape(-1, 5), rcond=None)[0]


def reliable_points(
    cloud: FrameCloud, largest_ratio: float = REGISTRATION_DEFAULTS.surface_map.largest_sigma_ratio
) -> Bool[ndarray, "n"]:
    """Points whose uncertainty is not far above the frame's median: those next to an epipole are left out."""
    sigma = cloud.sigma
    return sigma < largest_ratio * np.median(sigma)
