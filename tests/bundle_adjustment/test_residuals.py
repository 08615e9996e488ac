"""Residuals vanish at the truth, derivatives are those of the residuals, and the gauge is free."""

from collections.abc import Callable

import pytest
import torch

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.normal_equations import normal_equations
from sl_nerfstudio.bundle_adjustment.observations import observe, place_anchors
from sl_nerfstudio.bundle_adjustment.parameters import gauge_directions
from sl_nerfstudio.bundle_adjustment.residuals import OWN_PLACE_PX, Anchors, Linearisation, Rig, linearise, residuals_of
from sl_nerfstudio.geometry.lie import transform

from .analytic import ExactMaps, cast, dense, disturbed, images_of, rig_of

FRAMES, SIZE, STEP = 4, 80, 1e-6


@pytest.fixture(scope="module", params=["pinhole", "DOE"])
def scene(request):
    """True rig, decoded maps, and anchors with observations chosen at the truth."""
    rig = rig_of(FRAMES, SIZE, request.param)
    maps, generator = CoordinateMaps.of(images_of(rig, SIZE)), torch.Generator().manual_seed(0)
    anchors = place_anchors(rig, maps, 60, generator)
    return rig, maps, anchors, observe(rig, anchors, maps, 3, 8.0, 0.1, generator)


def test_residuals_of_a_true_rig_are_zero(scene):
    rig = scene[0]
    exact = ExactMaps.around(rig, SIZE)
    pixels = torch.Generator().manual_seed(1)
    anchors = place_anchors(rig, exact, 60, pixels)
    rows = observe(rig, anchors, exact, 3, 20.0, 0.1, pixels)
    r = residuals_of(rig, anchors, rows, exact)
    p = transform(rig.T_world_camera[anchors.frame], anchors.depth[:, None] * anchors.d_camera)[rows.anchor]
    way = p - rig.T_world_camera[rows.frame, :3, 3]
    length = way.norm(dim=-1)
    hidden = cast(rig.T_world_camera[rows.frame, :3, 3], way / length[:, None])[0] < length - 1e-6
    counts = r.cross_valid & ~hidden
    assert len(anchors.frame) > 3 * 60 and counts.sum() > 200
    assert r.own.abs().max() < 1e-8 and r.cross[counts].abs().max() < 1e-7


def moved(rig: Rig, which: int, frames: slice, index: int, step: float) -> Rig:
    """One component of delta (which = 0) or rho (1) of some frames changed."""
    x = torch.zeros(2, rig.frames, 6, dtype=torch.float64)
    x[which, frames, index] = step
    return rig.moved(x[0], x[1])


Agrees = Callable[[torch.Tensor, torch.Tensor, torch.Tensor], None]


def require_derivatives(rig: Rig, scene: tuple, linear: Linearisation, ok: torch.Tensor, agrees: Agrees) -> None:
    """All derivatives against central differences; `ok`: of which look-ups."""
    maps, anchors, observations = scene

    def difference(plus: Rig, minus: Rig, a: Anchors = anchors, b: Anchors = anchors):
        r, s = residuals_of(plus, a, observations, maps), residuals_of(minus, b, observations, maps)
        return (r.own - s.own) / (2 * STEP), (r.cross - s.cross) / (2 * STEP)

    every = torch.ones(len(anchors.frame), dtype=torch.bool)
    own, cross = difference(rig, rig, anchors.at(anchors.depth + STEP), anchors.at(anchors.depth - STEP))
    agrees(own, linear.own_depth, every)
    agrees(cross, linear.cross_depth, ok)
    i, j = anchors.frame[observations.anchor], observations.frame
    for k in range(6):
        own, _ = difference(*(moved(rig, 1, slice(None), k, s * STEP) for s in (1, -1)))
        agrees(own, linear.own[..., k], every)
        for frame in (0, FRAMES - 1):
            one = slice(frame, frame + 1)
            own, cross = difference(*(moved(rig, 0, one, k, s * STEP) for s in (1, -1)))
            assert torch.equal(own, torch.zeros_like(own))
            expected = torch.where((i == frame)[:, None], linear.cross[..., k], torch.zeros_like(cross))
            expected = torch.where((j == frame)[:, None], linear.cross[..., 6 + k], expected)
            agrees(cross, expected, ok)
            _, cross = difference(*(moved(rig, 1, one, k, s * STEP) for s in (1, -1)))
            expected = torch.where((j == frame)[:, None], linear.cross[..., 12 + k], torch.zeros_like(cross))
            agrees(cross, expected, ok)


def test_jacobians_are_central_differences_of_the_residuals(scene):
    """At a disturbed rig. A window's paraboloid is the same throughout its pixel, so the derivative is exact there."""
    true, maps, anchors, observations = scene
    rig = disturbed(true, 3, degrees=0.3, shift=0.01, relative=0.5)
    linear = linearise(rig, anchors, observations, maps)
    ok = linear.residuals.cross_valid
    assert ok.sum() > 150

    def agrees(found: torch.Tensor, expected: torch.Tensor, rows: torch.Tensor) -> None:
        scale = float(expected[rows].abs().max().clamp_min(1.0))
        error = ((found - expected)[rows].abs() / scale).amax(-1)
        assert (error > 1e-6).sum() <= 2  # a position may cross into the next pixel within the step

    require_derivatives(rig, (maps, anchors, observations), linear, ok, agrees)


@pytest.mark.parametrize("projector", ["pinhole", "DOE"])
def test_derivatives_by_normals_are_central_differences_at_the_truth(projector):
    """At the true rig, of frames that see the same surface: of that the derivatives take the normal."""
    rig, generator = rig_of(FRAMES, SIZE, projector), torch.Generator().manual_seed(0)
    maps = ExactMaps.around(rig, SIZE)
    anchors = place_anchors(rig, maps, 60, generator)
    observations = observe(rig, anchors, maps, 3, 20.0, 0.1, generator)
    linear = linearise(rig, anchors, observations, maps, OWN_PLACE_PX)
    ok = linear.residuals.cross_valid & (linear.residuals.cross.norm(dim=-1) < 1e-6)
    assert ok.sum() > 150

    def agrees(found: torch.Tensor, expected: torch.Tensor, rows: torch.Tensor) -> None:
        scale = float(expected[rows].abs().max().clamp_min(1.0))
        error = ((found - expected)[rows].abs() / scale).amax(-1)
        assert error.max() < 3e-4

    require_derivatives(rig, (maps, anchors, observations), linear, ok, agrees)


def test_the_gauge_and_nothing_else_is_free(scene):
    """At any rig, H is zero along seven directions and positive along all others."""
    true, maps, anchors, observations = scene
    rig, generator = disturbed(true, 5, degrees=0.5, shift=0.01, relative=0.5), torch.Generator().manual_seed(0)
    linear = linearise(rig, anchors, observations, maps)
    own, cross = (
        torch.rand(len(r), generator=generator, dtype=torch.float64) + 0.1 for r in (linear.own, linear.cross)
    )
    equations = normal_equations(linear, observations, own, cross * linear.residuals.cross_valid)
    G = gauge_directions(rig)
    assert torch.linalg.matrix_rank(G) == 7
    H, g = dense(equations)
    assert (H @ G).norm() < 1e-10 * H.norm() * G.norm()
    assert (G.T @ g).norm() < 1e-8 * g.norm() * G.norm()
    eigenvalues = torch.linalg.eigvalsh(H)
    assert eigenvalues[:7].abs().max() < 1e-12 * eigenvalues[-1]
    assert eigenvalues[7] > 1e-9 * eigenvalues[-1]
