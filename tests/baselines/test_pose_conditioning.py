"""The benchmark that fits poses to the known surface: its derivatives, and that every way leads to the truth."""

import pytest
import torch

from benchmarks.pose_conditioning import AdamChoice, Poses, Problem, adam, gauss_newton
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
