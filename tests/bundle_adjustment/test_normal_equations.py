"""The normal equations against dense least squares with all depths as unknowns."""

from math import radians

import pytest
import torch

from sl_nerfstudio.bundle_adjustment import levenberg_marquardt
from sl_nerfstudio.bundle_adjustment.levenberg_marquardt import DAMPING, LMState, damped_solver, lm_step
from sl_nerfstudio.bundle_adjustment.normal_equations import normal_equations
from sl_nerfstudio.bundle_adjustment.observations import Kernel, observe, place_anchors
from sl_nerfstudio.bundle_adjustment.parameters import PriorTerm, by_frame, by_kind, free_parameters
from sl_nerfstudio.bundle_adjustment.residuals import linearise, residuals_of

from .analytic import ExactMaps, columns_of, dense, disturbed, matrix_by_kind, prior_of, rig_of, without_prior

FRAMES, SIZE = 3, 60


def linear_system(seed: int):
    """Anchors, rows and derivatives at disturbed poses."""
    true, generator = rig_of(FRAMES, SIZE), torch.Generator().manual_seed(seed)
    maps, rig = ExactMaps.around(true, SIZE), disturbed(true, seed, degrees=0.3, shift=0.01, relative=0.5)
    anchors = place_anchors(rig, maps, 25, generator)
    rows = observe(rig, anchors, maps, 2, float("inf"), 0.1, generator)
    return anchors, rows, linearise(rig, anchors, rows, maps), generator


@pytest.mark.parametrize("seed", [0, 1])
def test_eliminated_depths_change_no_step(seed):
    """Dense equations of poses and depths together, their Schur complement, and the depths that follow from a step."""
    anchors, rows, linear, generator = linear_system(seed)
    own_weight = torch.rand(len(anchors.frame), generator=generator, dtype=torch.float64) + 0.1
    cross_weight = torch.rand(len(rows.anchor), generator=generator, dtype=torch.float64) * linear.residuals.cross_valid
    found = normal_equations(linear, rows, own_weight, cross_weight)

    n, m = linear.unknowns, len(anchors.frame)
    found_H, found_g = dense(found)
    own_columns, cross_columns = columns_of(linear)
    blocks = []
    every = torch.arange(m)
    for J, J_depth, r, w, columns, anchor in (
        (linear.own, linear.own_depth, linear.residuals.own, own_weight, own_columns, every),
        (linear.cross, linear.cross_depth, linear.residuals.cross, cross_weight, cross_columns, rows.anchor),
    ):
        full = torch.zeros(len(w), 2, n + m, dtype=torch.float64)
        for k in range(len(w)):
            full[k][:, columns[k]] += J[k]
            full[k][:, n + anchor[k]] += J_depth[k]
        root = w.sqrt()[:, None]
        blocks.append(((full * root[..., None]).reshape(-1, n + m), (r * root).reshape(-1)))
    A, b = (torch.cat(parts) for parts in zip(*blocks, strict=True))
    H, g = A.T @ A, A.T @ b
    poses, depths = slice(n), slice(n, None)
    over = torch.linalg.solve(H[depths, depths], torch.cat([H[depths, poses], g[depths, None]], 1))
    size = float(H.abs().max())
    assert torch.allclose(found_H, H[poses, poses] - H[poses, depths] @ over[:, :n], rtol=0, atol=1e-12 * size)
    assert torch.allclose(found_g, g[poses] - H[poses, depths] @ over[:, n], rtol=0, atol=1e-12 * size)
    assert torch.allclose(found_H, found_H.T, rtol=0, atol=1e-12 * size)
    x = torch.randn(n, generator=generator, dtype=torch.float64)
    wanted = -torch.linalg.solve(H[depths, depths], g[depths] + H[depths, poses] @ x)
    assert torch.allclose(found.depth_step(by_frame(x)), wanted, rtol=1e-9, atol=1e-9)
    assert torch.allclose(by_kind(found.times(by_frame(x))), found_H @ x, rtol=0, atol=1e-12 * size * float(x.norm()))


@pytest.mark.parametrize("frames", [[2, 0], [1]])
def test_some_frames_have_their_part_of_the_equations(frames):
    anchors, rows, linear, _ = linear_system(3)
    weights = torch.ones(len(anchors.frame), dtype=torch.float64), linear.residuals.cross_valid.double()
    some, n = torch.tensor(frames), 12 * len(frames)
    part, whole = normal_equations(linear, rows, *weights, some), normal_equations(linear, rows, *weights)
    H = without_prior(whole).reshape(FRAMES, 12, FRAMES, 12)[some][:, :, some].reshape(n, n)
    assert torch.allclose(without_prior(part), H, rtol=0, atol=1e-12 * float(H.abs().max()))
    assert torch.equal(part.g, whole.g[some])


# Damped steps: one lowers the whole objective or is not taken, and solves the damped equations.

FOUR, LARGE = 4, 80
MODES = ["free", "known-rig", "rigid-rig", "static-projector"]


@pytest.fixture(scope="module")
def scene():
    """Disturbed poses, with rows and residuals of exact maps."""
    true = rig_of(FOUR, LARGE)
    maps, generator = ExactMaps.around(true, LARGE), torch.Generator().manual_seed(0)
    rig = disturbed(true, 1, degrees=0.5, shift=0.02, relative=0.2)
    anchors = place_anchors(rig, maps, 60, generator)
    rows = observe(rig, anchors, maps, 3, float("inf"), 0.1, generator)
    return true, maps, rig, anchors, rows


def prior_term(weight: float, start, scale: float = 1.0) -> PriorTerm:
    return PriorTerm(prior_of(FOUR, 0.03 * scale, radians(scale), 0.01 * scale, radians(0.3 * scale)), start, weight)


def kernel_for(anchors, rows, width: float = 3.0) -> Kernel:
    return Kernel(torch.full((FOUR,), width, dtype=torch.float64), anchors.frame, rows.pairs(anchors))


def objective(state: LMState, rows, maps, kernel: Kernel, prior: PriorTerm, valid) -> float:
    return kernel.cost(residuals_of(state.rig, state.anchors, rows, maps), valid) + prior.energy(state.rig)


@pytest.mark.parametrize("weight", [0.0, 1e4])
@pytest.mark.parametrize("mode", MODES)
def test_a_step_lowers_data_and_prior_together(scene, mode, weight):
    _, maps, rig, anchors, rows = scene
    kernel = kernel_for(anchors, rows)
    prior, state = prior_term(weight, rig), LMState(rig, anchors, DAMPING)
    for _ in range(4):
        linear = linearise(state.rig, state.anchors, rows, maps)
        after = lm_step(state, linear, rows, maps, kernel, prior, free_parameters(mode, state.rig))
        both = linear.residuals.cross_valid & residuals_of(after.rig, after.anchors, rows, maps).cross_valid
        if after.size == 0:
            assert after.rig is state.rig and after.damping > state.damping
            break
        assert objective(after, rows, maps, kernel, prior, both) < objective(state, rows, maps, kernel, prior, both)
        state = after


def test_an_undamped_step_solves_the_normal_equations(scene, monkeypatch):
    true, maps, _, _, _ = scene
    rig, generator = disturbed(true, 2, degrees=0.02, shift=0.0005, relative=0.2), torch.Generator().manual_seed(1)
    anchors = place_anchors(rig, maps, 60, generator)
    rows = observe(rig, anchors, maps, 3, 2.0, 0.1, generator)
    kernel = kernel_for(anchors, rows, 1e3)
    linear, prior = linearise(rig, anchors, rows, maps), prior_term(1.0, rig)
    monkeypatch.setattr(levenberg_marquardt, "_LEAST_DEPTH", 0.0)
    monkeypatch.setattr(levenberg_marquardt, "_MOST_DEPTH", 10.0)
    found = lm_step(LMState(rig, anchors, 0.0), linear, rows, maps, kernel, prior, free_parameters("free", rig))
    equations = normal_equations(linear, rows, *kernel.weights(linear.residuals))
    H, g = dense(equations)
    H_prior, g_prior = prior.equations(rig)
    x = -torch.linalg.solve(H + matrix_by_kind(torch.block_diag(*H_prior), FOUR), g + by_kind(g_prior))
    wanted = rig.moved(*x.reshape(2, FOUR, 6))
    assert 1e-5 < found.size < 0.05
    assert torch.allclose(found.rig.T_world_camera, wanted.T_world_camera, atol=1e-9)
    assert torch.allclose(found.rig.T_camera_projector, wanted.T_camera_projector, atol=1e-9)
    assert torch.allclose(found.anchors.depth, anchors.depth + equations.depth_step(by_frame(x)), atol=1e-9)


@pytest.mark.parametrize("mode", MODES)
def test_conjugate_gradients_end_where_factorisation_does(scene, mode, monkeypatch):
    _, maps, rig, anchors, rows = scene
    kernel = kernel_for(anchors, rows)
    linear, prior = linearise(rig, anchors, rows, maps), prior_term(1e-2, rig)
    equations, free = normal_equations(linear, rows, *kernel.weights(linear.residuals)), free_parameters(mode, rig)
    exact = damped_solver(equations, prior.equations(rig), free)(1e-4)
    monkeypatch.setattr(levenberg_marquardt, "_FACTORISED_FRAMES", 0)
    monkeypatch.setattr(levenberg_marquardt, "_ITERATIVE_TOLERANCE", 1e-9)
    found = damped_solver(equations, prior.equations(rig), free)(1e-4)
    assert exact is not None and found is not None
    assert (found - exact).norm() < 1e-6 * exact.norm()
