"""Frames under one projector that stands differently against the camera in each, by formula."""

import numpy as np
import torch

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project
from sl_nerfstudio.relative_pose.unknown_projector import FrameMatches
from tests.relative_pose.two_views import CAMERA, pose_of, view

SHIFTED = Device(1280, 800, 2000.0, 2000.0, 630.0, 1360.0)
OFFSETS = ((1.0, 0.25, 0.1), (-0.9, 0.5, 0.3), (0.3, -1.1, -0.2), (0.2, 1.2, 0.6), (-1.2, -0.3, -0.4), (0.9, -0.8, 0.9))


def frames_of(
    projector: Device, count: int, noise: float = 0.0, alike: bool = False, relief: float = 1.0, points: int = 400
) -> list[FrameMatches]:
    """`alike`: all frames have the same relative pose and see other surfaces."""
    frames = []
    for k in range(count):
        which = 0 if alike else k
        seen = view(count=points, seed=k, relief=relief)
        T = aimed(OFFSETS[which], projector, 60.0 * which)
        p = (seen.p_camera - T[:3, 3]) @ T[:3, :3]
        uv, lit = project(Intrinsics.of(projector, torch.float64), torch.from_numpy(p))
        rng = np.random.default_rng(k)
        uv = uv.numpy() + noise * rng.standard_normal(uv.shape)
        assert lit.all()
        frames.append(FrameMatches(f"frame {k}", seen.uv_camera, uv, CAMERA))
    return frames


def aimed(offset: tuple[float, float, float], projector: Device, roll_deg: float) -> np.ndarray:
    """Pose of a projector whose image's middle looks at the surface, wherever its principal point is."""
    T = pose_of(offset, (0.0, 0.0, -4.5), roll_deg)
    x = (projector.w / 2 - projector.cx) / projector.fl_x
    y = -(projector.h / 2 - projector.cy) / projector.fl_y
    middle = np.array([x, y, -1.0]) / np.linalg.norm([x, y, -1.0])
    axis, target = np.cross(middle, [0.0, 0.0, -1.0]), np.array([0.0, 0.0, -1.0])
    s, c = np.linalg.norm(axis), middle @ target
    if s > 1e-12:
        hat = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
        T[:3, :3] = T[:3, :3] @ (np.eye(3) + hat + hat @ hat * ((1 - c) / s**2))
    return T
