"""Residuals vanish at the truth, derivatives are those of the residuals, and the gauge is free."""

import pytest
import torch

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.normal_equations import normal_equations
from sl_nerfstudio.bundle_adjustment.observations import observe, place_anchors
from sl_nerfstudio.bundle_adjustment.parameters import by_frame, gauge_directions
from sl_nerfstudio.bundle_adjustment.residuals import Anchors, Rig, linearise, residuals_of
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


def test_windows_of_pixels_in_place_of_rays_cost_a_fraction_of_a_pixel(scene):
    rig, maps, anchors, observations = scene
    r = residuals_of(rig, anchors, observations, maps)
    # a window of 5 x 5 pixels is a ninth of a ball's width here: its plane ignores the ball's curvature
    assert r.own.abs().median() < 0.1 and r.cross[r.cross_valid].abs().median() < 0.5


def test_linearise_agrees_with_residuals_of(scene):
    rig, maps, anchors, observations = scene
    linear, plain = (
        linearise(rig, anchors, observations, maps).residuals,
        residuals_of(rig, anchors, observations, maps),
    )
    assert torch.equal(linear.cross_valid, plain.cross_valid)
    assert torch.allclose(linear.own, plain.own, atol=1e-10) and torch.allclose(linear.cross, plain.cross, atol=1e-10)


def moved(rig: Rig, which: int, index: int, step: float) -> Rig:
    """One component of delta (which = 0) or rho (1) of all frames changed."""
    x = torch.zeros(2, rig.frames, 6, dtype=torch.float64)
    x[which, :, index] = step
    return rig.moved(x[0], x[1])


def single(rig: Rig, which: int, frame: int, index: int, step: float) -> Rig:
    x = torch.zeros(2, rig.frames, 6, dtype=torch.float64)
    x[which, frame, index] = step
    return rig.moved(x[0], x[1])


def test_jacobians_are_central_differences_of_the_residuals(scene):
    """At a disturbed rig. A window's plane is the same throughout its pixel, so the derivative is exact there."""
    true, maps, anchors, observations = scene
    rig = disturbed(true, 3, degrees=0.3, shift=0.01, relative=0.5)
    linear = linearise(rig, anchors, observations, maps)
    ok = linear.residuals.cross_valid
    assert ok.sum() > 150

    def difference(plus: Rig, minus: Rig, a: Anchors = anchors, b: Anchors = anchors):
        r, s = residuals_of(plus, a, observations, maps), residuals_of(minus, b, observations, maps)
        return (r.own - s.own) / (2 * STEP), (r.cross - s.cross) / (2 * STEP)

    def agrees(found: torch.Tensor, expected: torch.Tensor, rows: torch.Tensor) -> None:
        scale = float(expected[rows].abs().max().clamp_min(1.0))
        error = ((found - expected)[rows].abs() / scale).amax(-1)
        assert (error > 1e-6).sum() <= 2  # a position may cross into the next pixel within the step

    every = torch.ones(len(anchors.frame), dtype=torch.bool)
    own, cross = difference(rig, rig, anchors.at(anchors.depth + STEP), anchors.at(anchors.depth - STEP))
    agrees(own, linear.own_depth, every)
    agrees(cross, linear.cross_depth, ok)
    i, j = anchors.frame[observations.anchor], observations.frame
    for k in range(6):
        own, _ = difference(moved(rig, 1, k, STEP), moved(rig, 1, k, -STEP))
        agrees(own, linear.own[..., k], every)
        for frame in (0, FRAMES - 1):
            own, cross = difference(single(rig, 0, frame, k, STEP), single(rig, 0, frame, k, -STEP))
            assert torch.equal(own, torch.zeros_like(own))
            expected = torch.where((i == frame)[:, None], linear.cross[..., k], torch.zeros_like(cross))
            expected = torch.where((j == frame)[:, None], linear.cross[..., 6 + k], expected)
            agrees(cross, expected, ok)
            _, cross = difference(single(rig, 1, frame, k, STEP), single(rig, 1, frame, k, -STEP))
            expected = torch.where((j == frame)[:, None], linear.cross[..., 12 + k], torch.zeros_like(cross))
            agrees(cross, expected, ok)


def equations_of(rig, maps, anchors, observations, seed: int = 0):
    linear = linearise(rig, anchors, observations, maps)
    generator = torch.Generator().manual_seed(seed)
    own = torch.rand(len(anchors.frame), generator=generator, dtype=torch.float64) + 0.1
    cross = torch.rand(len(observations.frame), generator=generator, dtype=torch.float64) + 0.1
    cross = cross * linear.residuals.cross_valid
    return linear, own, cross, normal_equations(linear, observations, own, cross)


def test_normal_equations_are_those_of_the_dense_system(scene):
    """Solving for poses and depths together, by lstsq on the whole Jacobian, gives the same step."""
    true, maps, anchors, observations = scene
    rig = disturbed(true, 4, degrees=0.2, shift=0.003, relative=1.0)
    linear, own, cross, equations = equations_of(rig, maps, anchors, observations)
    n, m = rig.frames, len(anchors.frame)
    J = torch.zeros(m + len(observations.frame), 2, 12 * n + m, dtype=torch.float64)
    for a in range(m):
        f = int(anchors.frame[a])
        J[a, :, 6 * (n + f) : 6 * (n + f) + 6] = linear.own[a]
        J[a, :, 12 * n + a] = linear.own_depth[a]
    for row, (a, j) in enumerate(zip(observations.anchor.tolist(), observations.frame.tolist(), strict=True)):
        i = int(anchors.frame[a])
        for block, first in enumerate((6 * i, 6 * j, 6 * (n + j))):
            J[m + row, :, first : first + 6] = linear.cross[row, :, 6 * block : 6 * block + 6]
        J[m + row, :, 12 * n + a] = linear.cross_depth[row]
    root = torch.cat([own, cross]).sqrt()[:, None]
    r = torch.cat([linear.residuals.own, linear.residuals.cross])
    J, r = (J * root[..., None]).reshape(-1, 12 * n + m), (r * root).reshape(-1)
    H, g = J.T @ J, J.T @ r
    D = H.diagonal()[12 * n :]
    V = H[12 * n :, : 12 * n]
    schur = H[: 12 * n, : 12 * n] - V.T @ (V / D[:, None])
    scale = schur.abs().max()
    found_H, found_g = dense(equations)
    assert torch.allclose(found_H / scale, schur / scale, rtol=0, atol=1e-10)
    assert torch.allclose(found_g, g[: 12 * n] - V.T @ (g[12 * n :] / D), rtol=1e-8, atol=1e-6 * float(g.abs().max()))
    step = torch.randn(12 * n, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    expected = -(g[12 * n :] + V @ step) / D
    assert torch.allclose(equations.depth_step(by_frame(step)), expected, rtol=1e-8, atol=1e-9)


def test_the_gauge_and_nothing_else_is_free(scene):
    """At any rig, H is zero along seven directions and positive along all others."""
    true, maps, anchors, observations = scene
    rig = disturbed(true, 5, degrees=0.5, shift=0.01, relative=0.5)
    _, _, _, equations = equations_of(rig, maps, anchors, observations)
    G = gauge_directions(rig)
    assert torch.linalg.matrix_rank(G) == 7
    H, g = dense(equations)
    assert (H @ G).norm() < 1e-10 * H.norm() * G.norm()
    assert (G.T @ g).norm() < 1e-8 * g.norm() * G.norm()
    eigenvalues = torch.linalg.eigvalsh(H)
    assert eigenvalues[:7].abs().max() < 1e-12 * eigenvalues[-1]
    assert eigenvalues[7] > 1e-9 * eigenvalues[-1]


def test_without_observations_the_equations_are_those_of_own_views(scene):
    true, maps, anchors, observations = scene
    linear, own, cross, _ = equations_of(true, maps, anchors, observations)
    alone = normal_equations(linear, observations, own, torch.zeros_like(cross))
    H, _ = dense(alone)
    assert torch.equal(H[: 6 * FRAMES], torch.zeros_like(H[: 6 * FRAMES]))
    blocks = H[6 * FRAMES :, 6 * FRAMES :].reshape(FRAMES, 6, FRAMES, 6)
    off = ~torch.eye(FRAMES, dtype=torch.bool)
    assert blocks.transpose(1, 2)[off].abs().max() == 0
