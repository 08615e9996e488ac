"""A trained run whose field is a ball by formula, with a scan of that ball."""

from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch

from sl_nerfstudio.bundle_adjustment.covariance import JointCovariance
from sl_nerfstudio.bundle_adjustment.parameters import SelfCalibration
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.runs.run import TrainedRun
from sl_nerfstudio.scan import Scan
from tests.meshing.ray_cast_scan import pairs_around, scan_of
from tests.meshing.solids import ball

CENTRE, RADIUS = np.array([3.0, -2.0, 5.0]), 40.0  # of the ball, mm
S_SCENE_WORLD = Similarity(1 / 60, np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]), np.array([0.02, -0.03, 0.01]))


@dataclass
class BallModel:
    """What sl-export needs from a model, for a ball."""

    scan: Scan
    sigma: np.ndarray | None = None
    S_scene_world: Similarity = S_SCENE_WORLD
    cell: float = 1.0
    step: int = 10
    viewed_frame: int = 0
    last_unplaced: bool = False
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))

    def sdf(self, p_scene):
        centre = torch.from_numpy(self.S_scene_world.points(CENTRE)).float()
        return (p_scene - centre).norm(dim=-1) - RADIUS * self.S_scene_world.scale

    def poses(self):
        return self.scan.poses

    def poses_scene(self):
        p = self.scan.poses.mapped(self.S_scene_world)
        return torch.from_numpy(p.T_world_camera), torch.from_numpy(p.T_world_projector)

    def pose_sigma(self):
        return self.sigma

    def joint_covariance(self):
        return None if self.sigma is None else JointCovariance(1e-6 * np.eye(12 * len(self.scan.frames) + 6))

    def unplaced(self):
        return [False] * (len(self.scan.frames) - 1) + [self.last_unplaced]

    def self_calibration(self):
        return SelfCalibration(torch.full((6,), 0.01).double(), 1e-6 * torch.eye(6).double())

    def history(self):
        return {"step": [0.0, 5.0], "loss": [1.0, float("nan")]}


def ball_scan(root: Path) -> Scan:
    """Six captures of the ball from above."""
    return scan_of(ball(CENTRE.tolist(), RADIUS), pairs_around(6, 40), root)


def run_of(scan: Scan, sigma: np.ndarray | None = None) -> TrainedRun:
    """A finished run of ten steps on the scan."""
    settings = SimpleNamespace(
        method_name="sl-neus",
        max_num_iterations=10,
        output_dir=Path("outputs"),
        experiment_name="ball",
        timestamp="first",
        get_base_dir=lambda: Path("outputs/ball/sl-neus/first"),
        pipeline=SimpleNamespace(
            datamanager=SimpleNamespace(
                data=scan.root,
                train_num_rays_per_batch=7,
                dataparser=SimpleNamespace(intrinsics_change=scan.intrinsics_change),
            ),
            model={"lr": 1e-3, "where": Path("a")},
        ),
    )
    return TrainedRun(BallModel(scan, sigma), settings, 10)
