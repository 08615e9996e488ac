"""Unknowns of the adjustment: the prior, the gauge, what is free, and the intrinsics as unknowns."""

from dataclasses import replace

import pytest
import torch

from sl_nerfstudio.bundle_adjustment.adjust import Adjustment, adjust
from sl_nerfstudio.bundle_adjustment.covariance import joint_of_prior
from sl_nerfstudio.bundle_adjustment.observations import observe, place_anchors
from sl_nerfstudio.bundle_adjustment.parameters import (
    PosePrior,
    PriorTerm,
    agreeing_scale,
    baseline_scale,
    by_kind,
    free_parameters,
    gauge_directions,
    gauge_projection,
    linearise_with_intrinsics,
    prior_equations,
    restore,
)
from sl_nerfstudio.bundle_adjustment.residuals import Anchors, Rig, linearise, residuals_of
from sl_nerfstudio.bundle_adjustment.search import AdjustmentSettings
from sl_nerfstudio.geometry.devices import UNCHANGED, Intrinsics, IntrinsicsChange, project, unproject
from sl_nerfstudio.geometry.lie import exp_se3, inverse, log_se3, log_so3

from .analytic import ExactMaps, camera_of, disturbed, matrix_by_kind, prior_of, rig_of, without_gauge

FRAMES, SIZE = 4, 40
TWIST = (0.2, -0.1, 0.3, 0.2, 0.4, -0.1)


@pytest.mark.parametrize(
    "mode, columns", [("free", 36), ("rigid-rig", 24), ("known-rig", 18), ("static-projector", 18), ("off", 0)]
)
def test_free_directions_of_each_mode(mode, columns):
    rig = rig_of(3, SIZE)
    free = free_parameters(mode, rig)
    assert free.count == columns
    B = free.steps(torch.eye(columns, dtype=torch.float64)).flatten(0, 1)
    generator = torch.Generator().manual_seed(0)
    A, y = torch.randn(36, 36, dtype=torch.float64, generator=generator), torch.randn(36, generator=generator).double()
    assert torch.allclose(free.matrix(A + A.T), B.T @ (A + A.T) @ B, rtol=0, atol=1e-12)
    assert torch.allclose(free.vector(y.reshape(3, 12)), B.T @ y, rtol=0, atol=1e-12)
    x = torch.randn(columns, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    step = free.step(x)
    assert torch.allclose(step.flatten(), B @ x, rtol=0, atol=1e-12)
    delta, rho = step[:, :6], step[:, 6:]
    if columns:
        assert torch.linalg.matrix_rank(B) == columns and (delta != 0).all()
    if mode == "rigid-rig":
        assert torch.equal(rho, rho[:1].expand_as(rho)) and (rho != 0).all()
    if mode in ("known-rig", "off"):
        assert torch.equal(rho, torch.zeros_like(rho))
    if mode == "static-projector":
        stays = rig.moved(delta, rho).T_world_projector
        assert torch.allclose(stays, rig.T_world_projector, rtol=0, atol=1e-9)


def test_prior_equations_are_derivatives_of_the_weighted_difference():
    """To first order in the difference from the start, which is what a Gauss-Newton step needs."""
    n = 2
    true = rig_of(n, SIZE)
    sigmas = [torch.rand(n, dtype=torch.float64, generator=torch.Generator().manual_seed(s)) + 0.1 for s in range(4)]
    prior = PosePrior(*sigmas)
    rig = disturbed(true, 7, degrees=0.05, shift=0.001, relative=1.0)

    def half_cost(r: Rig) -> float:
        delta = log_se3(r.T_world_camera @ inverse(true.T_world_camera))
        t = r.T_camera_projector[:, :3, 3] - true.T_camera_projector[:, :3, 3]
        w = log_so3(r.T_camera_projector[:, :3, :3] @ true.T_camera_projector[:, :3, :3].transpose(1, 2))
        parts = (delta[:, :3], delta[:, 3:], t, w)
        return sum(float((p.pow(2).sum(-1) / s**2).sum()) / 2 for p, s in zip(parts, sigmas, strict=True))

    H, g = prior_equations(prior, true, rig)
    g = by_kind(g)
    step, expected = 1e-5, torch.zeros_like(g)
    for k in range(len(g)):
        x = torch.zeros(12 * n, dtype=torch.float64)
        x[k] = step
        plus, minus = (rig.moved(*(s * x).reshape(2, n, 6)) for s in (1, -1))
        expected[k] = (half_cost(plus) - half_cost(minus)) / (2 * step)
    assert (g - expected).abs().max() < 5e-3 * expected.abs().max()
    term = PriorTerm(prior, true, 3.0)
    assert term.energy(rig) == pytest.approx(6 * half_cost(rig), rel=1e-12)
    assert torch.equal(term.equations(rig)[0], 3 * H) and torch.equal(by_kind(term.equations(rig)[1]), 3 * g)
    factor = joint_of_prior(prior, rig)
    inverse_H = torch.linalg.inv(matrix_by_kind(torch.block_diag(*H), n))
    wanted = torch.block_diag(inverse_H, prior.intrinsics_sigma.square().diag())
    assert torch.allclose(factor @ factor.T, wanted, rtol=0, atol=1e-12)
    at_start = prior_equations(prior, true, true)[1]
    assert at_start.abs().max() < 1e-12 * float(H.abs().max())


def in_another_gauge(rig: Rig, factor: float) -> Rig:
    motion = exp_se3(torch.tensor(TWIST, dtype=torch.float64))
    scaled = rig.scaled(factor)
    return replace(scaled, T_world_camera=motion @ scaled.T_world_camera)


@pytest.mark.parametrize("known", [None, 0, 2])
def test_a_changed_gauge_is_undone(known):
    start = rig_of(FRAMES, SIZE)
    moved = in_another_gauge(start, 1.3)
    found = restore(start, moved, baseline_scale(start, moved, known))
    assert torch.allclose(found.T_world_camera, start.T_world_camera, rtol=0, atol=1e-12)
    assert torch.allclose(found.T_camera_projector, start.T_camera_projector, rtol=0, atol=1e-12)


@pytest.mark.parametrize("known", [None, 1])
def test_the_known_baseline_or_the_mean_is_kept(known):
    start = rig_of(FRAMES, SIZE)
    rig = in_another_gauge(disturbed(start, 1, relative=1.0), 0.8)
    before, after = start.baseline, restore(start, rig, baseline_scale(start, rig, known)).baseline
    assert not torch.allclose(before, after, rtol=1e-4)
    if known is None:
        assert float(after.log().mean() - before.log().mean()) == pytest.approx(0, abs=1e-13)
    else:
        assert float(after[known]) == pytest.approx(float(before[known]), rel=1e-13)
    assert torch.allclose(after / rig.baseline, (after / rig.baseline)[:1], rtol=1e-12)


@pytest.mark.parametrize("frames, relative", [(0.05, 0.05), (0.01, 0.3), (1e-6, 1.0), (1.0, 1e-6)])
def test_the_scale_that_agrees_best_is_the_weighted_least_squares_one(frames, relative):
    # baselines are 3 % too long relative to the cameras' positions: the two imply different scales
    start, long = rig_of(FRAMES, SIZE), 1.03
    rig = rig_of(FRAMES, SIZE)
    rig.T_camera_projector[:, :3, 3] *= long
    centre = start.T_world_camera[:, :3, 3]
    of_frames = float((centre - centre.mean(0)).pow(2).sum()) / frames**2
    of_baselines = float(start.baseline.pow(2).sum()) / relative**2
    expected = (of_frames + long * of_baselines) / (of_frames + long**2 * of_baselines)
    found = agreeing_scale(start, in_another_gauge(rig, 0.7), prior_of(FRAMES, frames, 0.1, relative, 0.01))
    assert found * 0.7 == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("frame", [None, 1])
def test_the_projection_is_what_restoring_leaves_of_small_increments(frame):
    true, generator = rig_of(4, 80), torch.Generator().manual_seed(3)
    x = 1e-6 * torch.randn(48, generator=generator, dtype=torch.float64)
    moved = true.moved(*x.reshape(2, 4, 6))
    back = restore(true, moved, baseline_scale(true, moved, frame))
    pairs = (back.T_world_camera, true.T_world_camera), (back.T_camera_projector, true.T_camera_projector)
    left = torch.cat([log_se3(now @ inverse(then)).reshape(-1) for now, then in pairs])
    P = gauge_projection(true, frame)
    assert torch.allclose(P @ x, left, atol=1e-10)
    assert (P @ gauge_directions(true)).abs().max() < 1e-9 and torch.allclose(P @ P, P, atol=1e-9)


def changed(devices: Intrinsics, change: tuple[float, ...]) -> Intrinsics:
    """Focal lengths and principal point changed by shares of the focal length."""
    params, f = devices.params.clone(), devices.params[..., :1]
    params[..., :2] *= 1 + change[0]
    params[..., 2:4] += f * torch.tensor(change[1:], dtype=params.dtype)
    return Intrinsics(params, devices.model, devices.distorted)


def with_change(rig: Rig, anchors: Anchors, which: int, size: float) -> tuple[Rig, Anchors]:
    """Change one of the six; the anchors keep their pixels, but not their rays."""
    values = [0.0] * 6
    values[which] = size
    camera = changed(rig.camera, tuple(values[:3]))
    uv = project(rig.camera[anchors.frame], anchors.d_camera)[0]
    d_camera = unproject(camera[anchors.frame], uv)
    rig = replace(rig, camera=camera, projector=changed(rig.projector, tuple(values[3:])))
    return rig, replace(anchors, d_camera=d_camera)


@pytest.mark.parametrize("projector", ["pinhole", "DOE"])
def test_columns_of_intrinsics_are_central_differences_of_the_residuals(projector):
    rig = rig_of(FRAMES, 100, projector)
    lens = replace(camera_of(100), k1=-0.08, p1=0.002)
    true = replace(rig, camera=Intrinsics.of([lens] * FRAMES, torch.float64))
    maps, generator = ExactMaps.around(true, 100), torch.Generator().manual_seed(0)
    rig = disturbed(true, 3, degrees=0.2, shift=0.005, relative=0.5)
    anchors = place_anchors(rig, maps, 40, generator)
    rows = observe(rig, anchors, maps, 3, 40.0, 0.1, generator)
    linear = linearise(rig, anchors, rows, maps)
    wide = linearise_with_intrinsics(linear, rig, anchors, rows, maps)
    ok = linear.residuals.cross_valid
    assert ok.sum() > 80 and wide.unknowns == linear.unknowns + 6
    assert torch.equal(wide.own[..., :6], linear.own) and torch.equal(wide.cross[..., :18], linear.cross)
    step = 1e-6
    for k in range(6):
        plus, minus = (residuals_of(*with_change(rig, anchors, k, s * step), rows, maps) for s in (1, -1))
        own, cross = (plus.own - minus.own) / (2 * step), (plus.cross - minus.cross) / (2 * step)
        assert torch.allclose(wide.own[..., 6 + k], own, rtol=1e-4, atol=1e-3)
        error = (wide.cross[..., 18 + k] - cross)[ok].abs() / cross[ok].abs().max()
        assert error.max() < 1e-4


def adjusted(true: Rig, wrong: tuple[float, ...], sigma: float, refined: IntrinsicsChange = UNCHANGED) -> Adjustment:
    """Poses adjusted to perfect coordinates with other intrinsics than those that made them."""
    stated = replace(true, camera=changed(true.camera, wrong[:3]), projector=changed(true.projector, wrong[3:]))
    prior = replace(prior_of(true.frames, 0.03, 0.02, 0.05, 0.02, intrinsics=sigma), intrinsics_change=refined)
    settings = AdjustmentSettings(anchors_per_frame=120, frames_per_anchor=3, max_iterations=40)
    return adjust(stated, ExactMaps.around(true, 100), prior, "free", settings)


def in_sigmas(found: Adjustment, true: Rig) -> float:
    """RMS error of all poses in units of the stated sigma."""
    return float((without_gauge(found.rig, true) / found.covariance.diagonal().sqrt()).pow(2).mean().sqrt())


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [(0.0,) * 6, (0.01, 0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, -0.008, 0.0, 0.006)])
def test_wrong_intrinsics_are_contradicted_and_measured_and_correct_ones_are_not(wrong):
    true = rig_of(5, 100)
    found = adjusted(true, wrong, 0.02 if any(wrong) else 0.01)
    estimate = found.intrinsics
    assert estimate is not None and estimate.contradicts() == any(wrong)
    left = (estimate.change + torch.tensor(wrong).double()).abs()  # of one linear step
    assert (left < 0.5 * estimate.covariance.diagonal().sqrt()).all() and float(left.max()) < 1.5e-3
    assert in_sigmas(found, true) < 1.5 or not any(wrong)
    if wrong[0]:  # assumed exact, they have too small an uncertainty
        assert in_sigmas(adjusted(true, wrong, 0.0), true) > 3


@pytest.mark.slow
@pytest.mark.parametrize("far", [0.0, 0.0025, 0.01])
def test_the_prior_pulls_a_change_already_made_back_to_the_stated_values(far):
    """If the captures say little, the step back to the stated values is as large as the change was."""
    change = (far, 0.0, 0.0, 0.0, 0.0, 0.0)
    gone = adjusted(rig_of(5, 100), change, 1e-6, IntrinsicsChange.of(change)).intrinsics
    assert gone is not None
    assert torch.allclose(gone.change, -torch.tensor(change).double(), rtol=0, atol=1e-4 if far else 1e-6)
