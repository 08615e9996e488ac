"""Stated uncertainty against the actual errors, and against matrices written out."""

from dataclasses import replace
from math import radians

import pytest
import torch
from torch import Tensor

from sl_nerfstudio.bundle_adjustment import covariance
from sl_nerfstudio.bundle_adjustment.adjust import adjust
from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.covariance import (
    DRAWS,
    Cholesky,
    CovarianceEvidence,
    as_stored,
    block_gradients,
    gauge_free,
    joint_of_prior,
    pose_covariance,
    stored_columns,
)
from sl_nerfstudio.bundle_adjustment.normal_equations import normal_equations
from sl_nerfstudio.bundle_adjustment.parameters import (
    UNKNOWNS,
    FreeParameters,
    PosePrior,
    SelfCalibration,
    by_frame,
    constrained,
    free_parameters,
    gauge_directions,
    prior_equations,
)
from sl_nerfstudio.bundle_adjustment.residuals import Rig
from sl_nerfstudio.bundle_adjustment.search import AdjustmentSettings

from .analytic import images_of, matrix_by_kind, prior_of, rig_of, without_gauge, without_prior

FRAMES, SIZE, SCANS = 4, 100, 10
SIGMAS = (0.03, radians(1.0), 0.01, radians(0.3))
PRIOR = prior_of(FRAMES, *SIGMAS, intrinsics=0.0)
SETTINGS = AdjustmentSettings(anchors_per_frame=150, frames_per_anchor=3, max_iterations=8, other_minima=False)
MODES = ("free", "rigid-rig", "known-rig", "static-projector")


def independent(generator: torch.Generator) -> Tensor:
    """The errors of all pixels are independent."""
    return 0.5 * torch.randn(FRAMES, SIZE, SIZE, 2, generator=generator)


def smooth(generator: torch.Generator) -> Tensor:
    """Errors are shared by whole corners of images, as with a lens that is modelled slightly wrong."""
    coarse = 0.3 * torch.randn(FRAMES, 2, 6, 6, generator=generator)
    return torch.nn.functional.interpolate(coarse, (SIZE, SIZE), mode="bicubic").permute(0, 2, 3, 1)


@pytest.mark.slow
@pytest.mark.parametrize("errors", [independent, smooth])
def test_errors_of_frames_are_as_large_as_stated(errors):
    true = rig_of(FRAMES, SIZE)
    images = images_of(true, SIZE)
    generator = torch.Generator().manual_seed(0)
    found = []
    for _ in range(SCANS):
        noisy = [image + e for image, e in zip(images, errors(generator), strict=True)]
        one = adjust(true, CoordinateMaps.of(noisy), PRIOR, "known-rig", SETTINGS)
        off = without_gauge(one.rig, true)[: 6 * FRAMES]
        found.append(off / one.covariance.diagonal()[: 6 * FRAMES].sqrt())
    rms = float(torch.stack(found).pow(2).mean().sqrt())
    assert 0.4 < rms < 2.5


@pytest.mark.parametrize("size", [1, 7, 600])
def test_products_with_the_inverse(size):
    generator = torch.Generator().manual_seed(0)
    A = torch.randn(size, size + 3, dtype=torch.float64, generator=generator)
    H, x = A @ A.T, torch.randn(size, 70, dtype=torch.float64, generator=generator)
    inverse, before = torch.linalg.inv(H), x.clone()
    factor = Cholesky.in_place(H)
    assert factor.upper.ctypes.data == H.data_ptr()  # a large matrix is in memory once
    error = 1e-9 * float(inverse.abs().max())
    root = factor.root(torch.eye(size, dtype=torch.float64))
    assert torch.allclose(root @ root.T, inverse, rtol=0, atol=error)
    assert torch.allclose(factor.root(x), root @ x, rtol=0, atol=10 * error)
    assert torch.allclose(factor.solution(x), inverse @ x, rtol=0, atol=10 * error) and torch.equal(x, before)
    with pytest.raises(ArithmeticError, match="order 1"):
        Cholesky.in_place(-torch.eye(3, dtype=torch.float64))


Arguments = tuple[CovarianceEvidence, FreeParameters, Rig, PosePrior, float]


@pytest.fixture(scope="module")
def at_results() -> dict[str, Arguments]:
    """What the covariance is computed from, at the results of adjustments with different free parameters."""
    true, found = rig_of(FRAMES, SIZE), {}
    errors = smooth(torch.Generator().manual_seed(1))
    maps = CoordinateMaps.of(image + e for image, e in zip(images_of(true, SIZE), errors, strict=True))
    prior = replace(PRIOR, intrinsics=0.005)
    for mode in MODES:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(
                "sl_nerfstudio.bundle_adjustment.adjust.pose_covariance",
                lambda *arguments, mode=mode: pose_covariance(*found.setdefault(mode, arguments)),
            )
            adjust(constrained(mode, true), maps, prior, mode, SETTINGS)
    return found


def by_inverses(
    e: CovarianceEvidence, free: FreeParameters, start: Rig, prior: PosePrior, noise: float
) -> tuple[Tensor, SelfCalibration]:
    """The covariance with all matrices written out, and the self-calibration."""
    n, weights = e.rig.frames, e.kernel.weights(e.linear.residuals)
    size = 12 * n + UNKNOWNS
    equations = normal_equations(e.linear, e.rows, *weights)
    smooth, along = (without_prior(normal_equations(x, e.rows, *weights)) for x in (e.smooth, e.along))
    H_frames, g_frames = prior_equations(prior, start, e.rig)
    weight = 1 / prior.intrinsics_sigma**2
    H_prior, g_prior = torch.block_diag(*H_frames, weight.diag()), torch.cat([g_frames.flatten(), torch.zeros(6)])
    B = torch.block_diag(free.steps(torch.eye(free.count, dtype=torch.float64)).flatten(0, 1), torch.eye(UNKNOWNS))
    G = torch.zeros(size, 7, dtype=torch.float64)
    G[: 12 * n] = by_frame(gauge_directions(e.rig)).flatten(0, 1)
    P = torch.eye(size) - G @ torch.linalg.pinv(G)
    columns, blocks = block_gradients(e, equations.depths, weights)
    g = torch.cat([equations.g.flatten(), equations.g_common])
    assert torch.allclose(columns.sum(1), g, rtol=0, atol=1e-9 * float(g.abs().max()))
    assert n < blocks <= e.blocks == columns.shape[1]
    curvature = max(e.kernel.curvature(e.linear.residuals), covariance._LEAST_CURVATURE)

    def moments(H_data: Tensor, noise: float) -> tuple[Tensor, Tensor, Tensor]:
        H = B.T @ (H_data + noise**2 * H_prior) @ B
        C = P @ B @ torch.linalg.inv(H) @ B.T
        left = max(blocks - len(H), blocks / 4)
        caused = blocks / left / curvature**2 * columns @ columns.T
        robust = (C @ (caused + noise**4 * H_prior) @ C.T).diagonal()
        formal = noise**2 * C @ P.T
        larger = (robust / formal.diagonal().clamp_min(1e-30)).clamp_min(1).sqrt()
        return formal, larger, -C @ (g + noise**2 * g_prior)

    formal, larger, step = moments(smooth, noise)
    own = torch.outer(larger, larger) * formal
    calibration = SelfCalibration(step[-UNKNOWNS:], own[-UNKNOWNS:, -UNKNOWNS:])
    moves = formal.diagonal()[:-UNKNOWNS] > 1e-25
    formal, larger, step = moments(along, float(larger[:-UNKNOWNS][moves].median()) * noise)
    return matrix_by_kind(torch.outer(larger, larger) * formal + torch.outer(step, step), n), calibration


@pytest.mark.parametrize("mode", MODES)
def test_factors_give_what_inverses_give(at_results, mode):
    wanted, calibration = by_inverses(*at_results[mode])
    factor, intrinsics = pose_covariance(*at_results[mode])
    sigma = wanted.diagonal().clamp_min(1e-18).sqrt()
    assert ((factor @ factor.T - wanted) / torch.outer(sigma, sigma)).abs().max() < 1e-6
    assert intrinsics is not None
    assert torch.allclose(intrinsics.change, calibration.change, rtol=1e-6)
    assert torch.allclose(intrinsics.covariance, calibration.covariance, rtol=1e-6, atol=1e-18)


@pytest.mark.parametrize("mode", MODES)
def test_random_columns_state_the_same_covariance(at_results, monkeypatch, mode):
    exact, _ = pose_covariance(*at_results[mode])
    monkeypatch.setattr(covariance, "EXACT_UNKNOWNS", 0)
    found, _ = pose_covariance(*at_results[mode])
    assert found.shape == (len(exact), DRAWS + 1)
    moves = exact.norm(dim=1) > 1e-9
    assert not found[~moves].abs().gt(1e-9).any()
    along = torch.randn(200, int(moves.sum()), dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    along = torch.cat([torch.eye(int(moves.sum()), dtype=torch.float64), along / exact[moves].norm(dim=1)])
    ratio = (along @ found[moves]).norm(dim=1) / (along @ exact[moves]).norm(dim=1)
    assert float(ratio.log().square().mean().sqrt()) < 2 / (2 * DRAWS) ** 0.5  # also of what poses have in common


def test_a_stored_factor_has_the_same_covariance(monkeypatch):
    generator = torch.Generator().manual_seed(0)
    for columns in (20, 30, 45):
        factor = torch.randn(30, columns, dtype=torch.float64, generator=generator)
        stored = as_stored(factor)
        assert stored.shape == (30, stored_columns(30)) == (30, 30)
        assert torch.allclose(stored @ stored.T, factor @ factor.T, rtol=0, atol=1e-12 * columns)
    monkeypatch.setattr(covariance, "EXACT_UNKNOWNS", 0)
    factor = torch.randn(30, DRAWS + 3, dtype=torch.float64, generator=generator)
    assert torch.equal(as_stored(factor)[:, : DRAWS + 3], factor) and not as_stored(factor)[:, DRAWS + 3 :].any()
    with pytest.raises(ValueError, match=f"{DRAWS + 9} columns, at most {DRAWS + 8}"):
        as_stored(torch.zeros(30, DRAWS + 9))


def test_captures_that_say_nothing_leave_the_prior(monkeypatch):
    """Its factor, exact and from random columns, with the scene's motion and growth taken out."""
    rig = rig_of(FRAMES, SIZE)
    for mode in ("free", "rigid-rig", "off"):
        free = free_parameters(mode, rig)
        H, _ = prior_equations(PRIOR, rig, rig)
        B = free.steps(torch.eye(free.count, dtype=torch.float64)).flatten(0, 1)
        G = by_frame(gauge_directions(rig)).flatten(0, 1)
        P = torch.eye(12 * FRAMES) - G @ torch.linalg.pinv(G)
        inner = torch.linalg.inv(B.T @ torch.block_diag(*H) @ B)
        wanted = matrix_by_kind(P @ B @ inner @ B.T @ P, FRAMES)
        factor = gauge_free(rig, free, H)
        assert torch.allclose(factor @ factor.T, wanted, rtol=0, atol=1e-9 * float(wanted.abs().max().clamp_min(1e-9)))
    monkeypatch.setattr(covariance, "EXACT_UNKNOWNS", 0)
    exact, prior = PRIOR.sigma, joint_of_prior(PRIOR, rig)
    assert prior.shape[1] == DRAWS
    assert ((prior[: 6 * FRAMES].norm(dim=1).reshape(FRAMES, 6) / exact[:, :6]).log().abs() < 0.15).all()
