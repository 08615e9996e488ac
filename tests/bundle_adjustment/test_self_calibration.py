"""Intrinsics as unknowns: derivatives are those of the residuals; wrong ones are detected, correct ones accepted."""

from dataclasses import replace

import pytest
import torch

from sl_nerfstudio.bundle_adjustment.adjust import Adjustment, adjust
from sl_nerfstudio.bundle_adjustment.observations import observe, place_anchors
from sl_nerfstudio.bundle_adjustment.parameters import PosePrior, gauge_directions, linearise_with_intrinsics
from sl_nerfstudio.bundle_adjustment.residuals import Anchors, Rig, linearise, residuals_of
from sl_nerfstudio.bundle_adjustment.settings import AdjustmentSettings
from sl_nerfstudio.geometry.devices import (
    UNCHANGED,
    Intrinsics,
    IntrinsicsChange,
    project,
    unproject,
)
from sl_nerfstudio.geometry.lie import inverse, log_se3

from .analytic import ExactMaps, camera_of, disturbed, rig_of

FRAMES, SIZE = 5, 100
CAMERA, PROJECTOR = (0, 1, 2), (3, 4, 5)


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
    return replace(rig, camera=camera, projector=changed(rig.projector, tuple(values[3:]))), replace(
        anchors, d_camera=d_camera
    )


@pytest.mark.parametrize("projector", ["pinhole", "DOE"])
def test_columns_are_central_differences_of_the_residuals(projector):
    rig = rig_of(FRAMES, SIZE, projector)
    lens = replace(camera_of(SIZE), k1=-0.08, p1=0.002)
    true = replace(rig, camera=Intrinsics.of([lens] * FRAMES, torch.float64))
    maps, generator = ExactMaps.around(true, SIZE), torch.Generator().manual_seed(0)
    rig = disturbed(true, 3, degrees=0.2, shift=0.005, relative=0.5)
    anchors = place_anchors(rig, maps, 40, generator)
    rows = observe(rig, anchors, maps, 3, 40.0, 0.1, generator)
    linear = linearise(rig, anchors, rows, maps)
    wide = linearise_with_intrinsics(linear, rig, anchors, rows, maps)
    ok = linear.residuals.cross_valid
    assert ok.sum() > 100 and wide.unknowns == linear.unknowns + 6
    assert torch.equal(wide.own[..., :6], linear.own) and torch.equal(wide.cross[..., :18], linear.cross)
    step = 1e-6
    for k in (*CAMERA, *PROJECTOR):
        plus, minus = (residuals_of(*with_change(rig, anchors, k, s * step), rows, maps) for s in (1, -1))
        own, cross = (plus.own - minus.own) / (2 * step), (plus.cross - minus.cross) / (2 * step)
        assert torch.allclose(wide.own[..., 6 + k], own, rtol=1e-4, atol=1e-3)
        error = (wide.cross[..., 18 + k] - cross)[ok].abs() / cross[ok].abs().max()
        assert error.max() < 1e-4


def adjusted(
    camera_change: tuple[float, ...],
    projector_change: tuple[float, ...],
    sigma: float,
    refined: IntrinsicsChange = UNCHANGED,
) -> Adjustment:
    """Poses adjusted to perfect coordinates with other intrinsics than those that made them."""
    true = rig_of(FRAMES, SIZE)
    stated = replace(
        true, camera=changed(true.camera, camera_change), projector=changed(true.projector, projector_change)
    )
    parts = (torch.full((FRAMES,), s, dtype=torch.float64) for s in (0.03, 0.02, 0.05, 0.02))
    settings = AdjustmentSettings(anchors_per_frame=120, frames_per_anchor=3, max_iterations=14)
    return adjust(stated, ExactMaps.around(true, SIZE), PosePrior(*parts, sigma, refined), "free", settings)


def off(found: Adjustment) -> torch.Tensor:
    """Errors of (delta, rho) without the gauge freedom."""
    true = rig_of(FRAMES, SIZE)
    delta = log_se3(found.rig.T_world_camera @ inverse(true.T_world_camera)).reshape(-1)
    rho = log_se3(found.rig.T_camera_projector @ inverse(true.T_camera_projector)).reshape(-1)
    G = gauge_directions(found.rig)
    error = torch.cat([delta, rho])
    return error - G @ torch.linalg.lstsq(G, error[:, None]).solution[:, 0]


def test_correct_intrinsics_are_not_contradicted():
    found = adjusted((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.01)
    assert found.intrinsics is not None and not found.intrinsics.contradicts()
    assert found.intrinsics.change.abs().max() < 4e-4


WRONG = [((0.01, 0.0, 0.0), (0.0, 0.0, 0.0)), ((0.0, 0.0, 0.0), (-0.008, 0.0, 0.006))]


@pytest.mark.parametrize("camera, projector", WRONG)
def test_wrong_intrinsics_are_contradicted(camera, projector):
    found = adjusted(camera, projector, 0.02)
    estimate = found.intrinsics
    assert estimate is not None and estimate.contradicts()
    wanted = -torch.tensor([*camera, *projector], dtype=torch.float64)
    assert torch.allclose(estimate.change, wanted, rtol=0, atol=4e-4)  # of a change of 1e-2: one linear step
    assert float((off(found) / found.covariance.diagonal().sqrt()).pow(2).mean().sqrt()) < 1.5


def test_poses_from_wrong_intrinsics_assumed_exact_have_too_small_an_uncertainty():
    found = adjusted(*WRONG[0], 0.0)
    assert float((off(found) / found.covariance.diagonal().sqrt()).pow(2).mean().sqrt()) > 3


@pytest.mark.parametrize("share", [0.25, 1.0])
def test_the_prior_pulls_a_change_already_made_back_to_the_stated_values(share):
    """If the captures say little, the step back to the stated values is as large as the change was."""
    far = 0.01 * share
    held = adjusted((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1e-6).intrinsics
    gone = adjusted(
        (far, 0.0, 0.0), (0.0, 0.0, 0.0), 1e-6, IntrinsicsChange.of((far, 0.0, 0.0, 0.0, 0.0, 0.0))
    ).intrinsics
    assert held is not None and held.change.abs().max() < 1e-6
    assert gone is not None
    assert torch.allclose(gone.change, torch.tensor([-far, 0, 0, 0, 0, 0]).double(), rtol=0, atol=1e-4)
