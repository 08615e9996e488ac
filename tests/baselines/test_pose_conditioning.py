"""The benchmark that fits poses to the known surface: its derivatives, and that every way leads to the truth."""

from dataclasses import replace

import pytest
import torch

from benchmarks.pose_conditioning.problem import Poses, Problem, of_devices, per_frame
from benchmarks.pose_conditioning.steps import AdamChoice, adam, gauss_newton, normal_matrices, rate_at, whitening
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


def test_the_gradient_is_the_sum_over_the_residuals(problem):
    surface, true = problem
    poses, index = disturbed(true, 1e-2), torch.arange(0, len(surface.frame), 3)
    r = surface.residuals(poses, index)
    for found, J in zip(surface.gradient(poses, index), (r.by_camera, r.by_projector), strict=True):
        expected = per_frame(r.frame, (r.value.sign()[:, None] @ J)[:, 0], surface.frames)
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-6)


def test_increments_of_a_rig_move_a_frame_as_a_whole_and_its_projector_against_its_camera(problem):
    _, true = problem
    camera, projector = of_devices(true, independent=False)
    generator = torch.Generator().manual_seed(1)
    small = 1e-5 * torch.randn(len(true.camera), 12, 1, generator=generator, dtype=torch.float64)
    relative = torch.linalg.inv(true.camera) @ true.projector
    whole = small.clone()
    whole[:, 6:] = 0
    moved = true.moved((camera @ whole)[..., 0], (projector @ whole)[..., 0])
    torch.testing.assert_close(torch.linalg.inv(moved.camera) @ moved.projector, relative, atol=1e-9, rtol=0)
    own = small.clone()
    own[:, :6] = 0
    moved = true.moved((camera @ own)[..., 0], (projector @ own)[..., 0])
    torch.testing.assert_close(moved.camera, true.camera)


def test_whitened_increments_have_equal_eigenvalues_and_the_same_geometric_mean(problem):
    surface, true = problem
    H = normal_matrices(surface, true, False, 500, 0)
    W = whitening(H)
    value = torch.linalg.eigvalsh(W.mT @ H @ W)
    torch.testing.assert_close(
        value, torch.linalg.eigvalsh(H).log().mean(-1).exp()[:, None].expand(-1, 12), rtol=1e-6, atol=0
    )


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


def test_rates_are_those_of_the_methods():
    assert rate_at("exponential", 0, 10_000) == rate_at("cosine", 0, 10_000) == 1e-3
    assert rate_at("exponential", 8000, 10_000) == pytest.approx(5e-12)
    assert rate_at("exponential", 9999, 10_000) == pytest.approx(5e-12)
    assert rate_at("cosine", 10_000, 10_000) == pytest.approx(1e-5)


def test_rays_that_miss_the_surface_say_nothing(problem):
    surface, true = problem
    away = replace(true, camera=true.camera.clone())
    away.camera[:, :3, 3] += 50
    index = torch.arange(0, len(surface.frame), 50)
    assert len(surface.residuals(away, index).value) == 0
    assert all(not g.any() for g in surface.gradient(away, index))
