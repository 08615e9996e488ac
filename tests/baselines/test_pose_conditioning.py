"""The benchmark that fits poses to the known surface: its derivatives, and that every way leads to the truth."""

import pytest
import torch

from benchmarks.pose_conditioning import (
    AdamChoice,
    Poses,
    Problem,
    adam,
    gauss_newton,
)
from sl_nerfstudio.dataparser.dataparser import load_scan
from sl_nerfstudio.meshing.files import read_mesh
from sl_nerfstudio.scan import read_ground_truth


@pytest.fixture(scope="module")
def problem(clean_scan) -> tuple[Problem, Poses]:
    """Exact coordinates of a polyhedron, and the true poses in the scene."""
    loaded = load_scan(clean_scan)
    truth = read_ground_truth(loaded.scan)
    assert truth.mesh_path is not None and truth.poses is not None
    scene = truth.poses.mapped(loaded.S_scene_world)
    poses = Poses(torch.from_numpy(scene.T_world_camera), torch.from_numpy(scene.T_world_projector))
    return Problem(loaded, read_mesh(truth.mesh_path)), poses


def disturbed(poses: Poses, size: float) -> Poses:
    generator = torch.Generator().manual_seed(4)
    twists = size * torch.randn(2, len(poses.camera), 6, generator=generator, dtype=torch.float64)
    return poses.moved(*twists)


def mean_residual(problem: Problem, poses: Poses) -> float:
    return float(problem.residuals(poses, torch.arange(len(problem.frame))).value.norm(dim=-1).mean())


def test_true_poses_predict_what_was_decoded(problem):
    surface, true = problem
    residuals = surface.residuals(true, torch.arange(len(surface.frame)))
    assert len(residuals.value) > 0.99 * len(surface.frame)
    assert residuals.value.abs().median() < 1e-4  # coordinates are stored in single precision


@pytest.mark.parametrize("device", ["camera", "projector"])
def test_derivatives_agree_with_central_differences(problem, device):
    surface, true = problem
    poses, index, step = disturbed(true, 1e-3), torch.arange(0, len(surface.frame), 7), 1e-6
    found = surface.residuals(poses, index)
    J = found.by_camera if device == "camera" else found.by_projector
    zero = torch.zeros(surface.frames, 6, dtype=torch.float64)
    for k in range(6):
        twist = zero.clone()
        twist[:, k] = step
        moved = [poses.moved(t, zero) if device == "camera" else poses.moved(zero, t) for t in (twist, -twist)]
        ends = [surface.residuals(p, index).value for p in moved]
        assert len(ends[0]) == len(ends[1]) == len(J)
        error = ((ends[0] - ends[1]) / (2 * step) - J[..., k]).abs() / J[..., k].abs().mean()
        assert (error.max(1).values < 1e-5).float().mean() > 0.97  # rays that step over an edge of the polyhedron


def test_gauss_newton_and_whitened_adam_come_back_to_the_truth_and_plain_adam_lags_behind(problem):
    surface, true = problem
    start = disturbed(true, 3e-3)
    first = mean_residual(surface, start)
    assert mean_residual(surface, gauss_newton(surface, start, 15, 700, 0)) < 1e-3 * first
    ends = {}
    for increments in ("independent", "rig", "whitened"):
        found = adam(surface, start, AdamChoice(increments, "cosine"), 200, 300, 0)
        ends[increments] = mean_residual(surface, found)
    assert ends["whitened"] < 0.1 * first and ends["rig"] < 0.5 * first
    assert ends["whitened"] < min(ends["rig"], ends["independent"])
