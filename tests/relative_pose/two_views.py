"""Frames by formula: points on a surface, seen by a camera and lit by projectors whose poses are known."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project, unproject
from sl_nerfstudio.relative_pose.epipolar import EpipolarFit, covariance, noise_of, ray_pairs, sampson
from sl_nerfstudio.relative_pose.estimation import INLIER_SIGMAS, RelativePose
from sl_nerfstudio.relative_pose.joint_fit import FrameMatches
from tests.formulas import look_at

CAMERA = Device(640, 480, 800.0, 790.0, 322.0, 238.0)
PROJECTORS = {
    "pinhole": Device(800, 800, 1100.0, 1110.0, 395.0, 405.0),
    "lens": Device(800, 800, 1100.0, 1110.0, 395.0, 405.0, k1=-0.15, k2=0.05, p1=1e-3, p2=-2e-3),
    "DOE": Device(800, 800, 1250.0, 1250.0, 400.0, 400.0, model="DOE"),
}


@dataclass(frozen=True)
class View:
    """Correspondences with the pose and the points they come from."""

    camera: Device
    projector: Device
    T_camera_projector: ndarray
    uv_camera: ndarray
    uv_projector: ndarray
    p_camera: ndarray

    def noisy(self, sigma: float, seed: int, wrong: float = 0.0) -> "View":
        """Independent noise, and a fraction of coordinates that are off by 20 to 80 pixels."""
        rng = np.random.default_rng(seed)
        uv = self.uv_projector + sigma * rng.standard_normal(self.uv_projector.shape)
        off = rng.random(len(uv)) < wrong
        uv[off] += rng.uniform(20, 80, (off.sum(), 2)) * rng.choice([-1, 1], (off.sum(), 2))
        return replace(self, uv_projector=uv)

    @property
    def arguments(self) -> tuple[ndarray, ndarray, Device, Device]:
        """What estimate_relative_pose takes."""
        return self.uv_camera, self.uv_projector, self.camera, self.projector


def pose_of(offset: tuple[float, float, float], target: tuple[float, float, float], roll_deg: float) -> ndarray:
    """Pose in camera axes of a projector at `offset` that looks at `target`."""
    return look_at(offset, target, np.radians(roll_deg), up=(0.0, 1.0, 0.0))


def view(
    projector: str = "pinhole",
    offset: tuple[float, float, float] = (1.0, 0.25, 0.1),
    relief: float = 1.0,
    count: int = 4000,
    seed: int = 0,
    roll_deg: float = 10.0,
) -> View:
    """A bumpy surface about 4.5 away and 1.5 wide; `relief` 0 makes it a plane. All points are lit and seen."""
    rng = np.random.default_rng(seed)
    device, centre = PROJECTORS[projector], (0.0, 0.0, -4.5)
    uv = rng.uniform([180, 100], [460, 380], (count, 2))
    d = unproject(Intrinsics.of(CAMERA, torch.float64), torch.from_numpy(uv)).numpy()
    x, y = d[:, 0] / -d[:, 2], d[:, 1] / -d[:, 2]
    bumps = np.sin(9 * x + 1) * np.cos(7 * y) + 0.6 * np.sin(23 * x * y + 5 * y) - 6 * (x * x + y * y)
    depth = 4.5 / (1 - 0.2 * x - 0.1 * y) - relief * 0.45 * bumps
    p = d * (depth / -d[:, 2])[:, None]
    T = pose_of(offset, centre, roll_deg)
    p_projector = (p - T[:3, 3]) @ T[:3, :3]
    uv_projector, lit = project(Intrinsics.of(device, torch.float64), torch.from_numpy(p_projector))
    assert lit.all()
    return View(CAMERA, device, T, uv, uv_projector.numpy(), p)


def errors_deg(T_found: ndarray, T_true: ndarray) -> tuple[float, float]:
    """Angle of the rotation's error and of the baseline direction's."""
    turn = Rotation.from_matrix(T_true[:3, :3].T @ T_found[:3, :3]).magnitude()
    a, b = (T[:3, 3] / np.linalg.norm(T[:3, 3]) for T in (T_found, T_true))
    swing = np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)
    return float(np.degrees(turn)), float(np.degrees(swing))


def true_pose(frame: View) -> tuple[ndarray, ndarray]:
    """The rotation and the unit baseline of a frame."""
    T = frame.T_camera_projector
    return T[:3, :3], T[:3, 3] / np.linalg.norm(T[:3, 3])


def matrix_of(R: ndarray, t: ndarray) -> ndarray:
    """A pose as a matrix."""
    return np.block([[R, t[:, None]], [np.zeros(3), 1.0]])


def known_pose(
    T_camera_projector: ndarray, uv_camera: ndarray, uv_projector: ndarray, camera: Device, projector: Device
) -> RelativePose:
    """A relative pose that is known, with the covariance and inliers that a frame's coordinates give it."""
    rays, usable = ray_pairs(uv_camera, uv_projector, camera, projector)
    T = T_camera_projector.copy()
    T[:3, 3] /= np.linalg.norm(T[:3, 3])
    r = sampson(T[:3, :3], T[:3, 3], rays)
    fit = EpipolarFit(T[:3, :3], T[:3, 3], r, noise_of(r))
    inliers, noise_px = np.zeros(len(uv_camera), dtype=bool), np.full(len(uv_camera), np.nan)
    inliers[usable] = np.abs(r) < INLIER_SIGMAS * fit.noise_px
    noise_px[usable] = fit.noise_px
    return RelativePose(T, covariance(fit, rays), inliers, fit.noise_px, noise_px, 1.0, ())


SHIFTED = Device(1280, 800, 2000.0, 2000.0, 630.0, 1360.0)
OFFSETS = ((1.0, 0.25, 0.1), (-0.9, 0.5, 0.3), (0.3, -1.1, -0.2), (0.2, 1.2, 0.6), (-1.2, -0.3, -0.4), (0.9, -0.8, 0.9))


def frames_of(
    projector: Device, count: int, noise: float = 0.0, alike: bool = False, relief: float = 1.0, points: int = 400
) -> list[FrameMatches]:
    """Frames under one projector that stands differently in each; `alike`: they differ in their surfaces alone."""
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


def aimed(offset: tuple[float, float, float], projector: Device, roll_deg: float) -> ndarray:
    """Pose of a projector whose image's middle looks at the surface, wherever its principal point is."""
    T = pose_of(offset, (0.0, 0.0, -4.5), roll_deg)
    x = (projector.w / 2 - projector.cx) / projector.fl_x
    y = -(projector.h / 2 - projector.cy) / projector.fl_y
    middle = np.array([x, y, -1.0]) / np.linalg.norm([x, y, -1.0])
    axis = np.cross(middle, [0.0, 0.0, -1.0])
    if (sine := np.linalg.norm(axis)) > 1e-12:
        T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(np.arctan2(sine, -middle[2]) * axis / sine).as_matrix()
    return T
