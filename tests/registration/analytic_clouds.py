"""Frame clouds of the analytic scene, with known relative poses, and what registration should make of them."""

from dataclasses import replace

import numpy as np
import torch
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.bundle_adjustment.residuals import Rig
from sl_nerfstudio.geometry.lie import Similarity, fit_similarity
from sl_nerfstudio.registration.surfaces import FrameCloud, centre_and_radius, frame_cloud
from sl_nerfstudio.relative_pose.epipolar import correspondences_of
from tests.bundle_adjustment.analytic import PROJECTORS, camera_of, images_of
from tests.relative_pose.two_views import known_pose


def clouds_of(rig: Rig, size: int, projector: str = "pinhole", noise: float = 0.0) -> list[FrameCloud]:
    """One cloud a frame, of exact or noisy coordinates and exact relative poses of unknown length."""
    rng, out = np.random.default_rng(0), []
    for k, image in enumerate(images_of(rig, size)):
        coords = image.numpy() + noise * rng.standard_normal(image.shape).astype(np.float32)
        camera, device = camera_of(size), PROJECTORS[projector]
        T = rig.T_camera_projector[k].numpy()
        uv = correspondences_of(coords)
        out.append(frame_cloud(f"frame_{k:05d}", coords, camera, device, known_pose(T, *uv, camera, device)))
    return out


def part_of(rig: Rig, frames: list[int]) -> Rig:
    """Some frames of a rig."""
    index = torch.tensor(frames)
    return Rig(rig.camera[index], rig.projector, rig.T_world_camera[index], rig.T_camera_projector[index])


def similarities_of(T_world_camera: ndarray, baseline: ndarray) -> list[Similarity]:
    """`S_world_camera` of frames: camera axes in units of the baseline, to the world."""
    return [Similarity(float(b), T[:3, :3], T[:3, 3]) for T, b in zip(T_world_camera, baseline, strict=True)]


def errors_against(rig: Rig, T_world_camera: ndarray, baseline: ndarray) -> tuple[ndarray, ndarray, ndarray]:
    """Rotation (degrees), position (scene radii) and scale error of each frame, after one common similarity."""
    true_camera = rig.T_world_camera.numpy()
    true_baseline = rig.T_camera_projector[:, :3, 3].norm(dim=-1).numpy()
    return pose_errors(true_camera, true_baseline, T_world_camera, baseline)


def pose_errors(
    true_camera: ndarray, true_baseline: ndarray, T_world_camera: ndarray, baseline: ndarray
) -> tuple[ndarray, ndarray, ndarray]:
    """The same for any scene; positions in mean distances of the cameras from their centre."""
    ahead = np.linalg.norm(true_camera[:, :3, 3] - true_camera[:, :3, 3].mean(0), axis=1).mean()
    scale = float(np.exp(np.mean(np.log(true_baseline / baseline))))
    ends = [
        np.concatenate([T[:, :3, 3], T[:, :3, 3] - s * ahead * T[:, :3, 2]])
        for T, s in ((T_world_camera, 1 / scale), (true_camera, 1.0))
    ]
    S = fit_similarity(ends[0], ends[1])
    found = S.poses(T_world_camera)
    turn = Rotation.from_matrix(np.swapaxes(true_camera[:, :3, :3], 1, 2) @ found[:, :3, :3]).magnitude()
    shift = np.linalg.norm(found[:, :3, 3] - true_camera[:, :3, 3], axis=1) / ahead
    return np.degrees(turn), shift, baseline * S.scale / true_baseline - 1


def difference(a: Similarity, b: Similarity, centre: ndarray) -> tuple[float, float, float]:
    """Angle in degrees, shift of the centre and relative scale."""
    D = a @ b.inverse()
    angle = np.degrees(Rotation.from_matrix(D.R).magnitude())
    return float(angle), float(np.linalg.norm(D.points(centre[None])[0] - centre)), abs(D.scale - 1)


def rolled(degrees: float) -> ndarray:
    """Rotation about the line of sight."""
    return Rotation.from_euler("z", degrees, degrees=True).as_matrix()


def on_a_ball(cloud: FrameCloud, radius: float, name: str) -> FrameCloud:
    """The frame as if it had seen nothing but a ball about the middle of its points."""
    middle, size = centre_and_radius(cloud.points)
    centre = middle * (1 + 0.5 * size / np.linalg.norm(middle))
    ray = cloud.points / np.linalg.norm(cloud.points, axis=1, keepdims=True)
    b = ray @ centre
    root = b * b - centre @ centre + (radius * size) ** 2
    hit = root > 0
    points = ray[hit] * (b[hit] - np.sqrt(root[hit]))[:, None]
    parts = {k: getattr(cloud, k)[hit] for k in ("uv_camera", "sigma_noise", "pose_errors")}
    return replace(cloud, name=name, points=points, **parts)
