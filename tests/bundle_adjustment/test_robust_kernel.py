"""The Geman-McClure kernel: weights are the derivative of the cost, widths shrink with the residuals."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sl_nerfstudio.bundle_adjustment.observations import (
    Kernel,
    frame_medians,
    narrowed,
    noise_of,
    noise_ratios,
    useful_distance,
)
from sl_nerfstudio.bundle_adjustment.residuals import Residuals
from sl_nerfstudio.bundle_adjustment.settings import KernelSettings

SETTINGS = KernelSettings()
FRAME = torch.tensor([0, 0, 1, 2])  # of four anchors
PAIR = torch.tensor([[0, 0, 1, 2, 2], [1, 2, 0, 0, 1]])  # of five rows


def residuals(seed: int, size: float = 1.0, invalid: bool = False) -> Residuals:
    generator = torch.Generator().manual_seed(seed)
    own, cross = (size * torch.randn(n, 2, generator=generator, dtype=torch.float64) for n in (4, 5))
    valid = torch.ones(5, dtype=torch.bool)
    valid[3] = not invalid
    return Residuals(own, cross, valid)


def kernel(*widths: float) -> Kernel:
    return Kernel(torch.tensor(widths, dtype=torch.float64), FRAME, PAIR)


@given(st.integers(0, 50), st.floats(0.05, 20.0), st.booleans())
def test_weights_are_the_derivative_of_the_cost(seed, size, invalid):
    """Half the gradient of the cost is weight times residual, so a step of the normal equations descends."""
    r, k = residuals(seed, size, invalid), kernel(0.5, 2.0, 1.0)
    own, cross = r.own.clone().requires_grad_(), r.cross.clone().requires_grad_()
    (w_own, w_cross), own2, cross2 = k.weights(r), k.width[FRAME] ** 2, k.width[PAIR].amax(0) ** 2
    squares = ((own**2).sum(-1), own2), ((cross**2).sum(-1)[r.cross_valid], cross2[r.cross_valid])
    cost = k.narrowest**2 * sum((r2 / (w2 + r2)).sum() for r2, w2 in squares)
    assert k.cost(r, r.cross_valid) == pytest.approx(cost.item(), rel=1e-12)
    g_own, g_cross = torch.autograd.grad(cost, (own, cross))
    assert torch.allclose(g_own / 2, w_own[:, None] * r.own, rtol=1e-10, atol=1e-14)
    assert torch.allclose(g_cross / 2, w_cross[:, None] * r.cross, rtol=1e-10, atol=1e-14)


@given(st.integers(0, 50), st.floats(0.05, 1.0), st.booleans())
def test_curvature_is_that_of_the_cost_relative_to_its_weights(seed, size, invalid):
    r, k = residuals(seed, size, invalid), kernel(0.5, 2.0, 1.0)
    squares = torch.cat([k.width[FRAME] ** 2, k.width[PAIR].amax(0)[r.cross_valid] ** 2])
    values = torch.cat([r.own, r.cross[r.cross_valid]])

    def cost(x):
        r2 = (x.reshape(-1, 2) ** 2).sum(-1)
        return k.narrowest**2 * (r2 / (squares + r2)).sum()

    hessian = torch.autograd.functional.hessian(cost, values.reshape(-1))
    weights = torch.cat([k.weights(r)[0], k.weights(r)[1][r.cross_valid]])
    assert k.curvature(r) == pytest.approx(float(hessian.trace() / 4 / weights.sum()), rel=1e-9, abs=1e-12)


def test_a_gross_error_costs_the_same_at_any_width():
    far = Residuals(*(torch.full((n, 2), 1e6, dtype=torch.float64) for n in (4, 5)), torch.ones(5, dtype=torch.bool))
    assert kernel(0.5, 2.0, 1.0).cost(far, far.cross_valid) == pytest.approx(9 * 0.5**2, rel=1e-6)
    assert kernel(0.5, 0.5, 0.5).cost(far, far.cross_valid) == pytest.approx(9 * 0.5**2, rel=1e-6)


def test_rows_that_cannot_be_seen_have_no_weight():
    r = residuals(1, invalid=True)
    weight = kernel(1.0, 1.0, 1.0).weights(r)[1]
    assert weight[3] == 0 and (weight[r.cross_valid] > 0).all()


def test_medians_are_of_the_residuals_that_involve_a_frame():
    r = residuals(2)
    size = r.cross.norm(dim=-1)
    found = frame_medians(r, PAIR, 4)
    assert found[0] == size[[0, 1, 2, 3]].median() and found[1] == size[[0, 2, 4]].median()
    assert torch.isinf(found[3])


@given(st.lists(st.integers(0, 5), min_size=1, max_size=40), st.integers(0, 1000))
def test_medians_are_those_of_torch_also_with_equal_values(values, seed):
    """Each row involves frames 0 and 1, half of them in the other order."""
    size = torch.tensor(values, dtype=torch.float64)
    valid = torch.rand(len(values), generator=torch.Generator().manual_seed(seed)) < 0.8
    rows = torch.stack([size, torch.zeros_like(size)], -1)
    turned = torch.arange(len(values)) % 2
    found = frame_medians(Residuals(torch.zeros(1, 2).double(), rows, valid), torch.stack([turned, 1 - turned]), 2)
    expected = size[valid].median() if valid.any() else torch.tensor(float("inf")).double()
    assert (found == expected).all()


def column(value: float) -> torch.Tensor:
    return torch.tensor([value], dtype=torch.float64)


@given(st.floats(0.01, 10.0), st.floats(0.01, 10.0))
def test_widths_narrow_gradually_and_never_widen(width, target):
    found = float(narrowed(column(width), column(target), SETTINGS))
    assert found == pytest.approx(min(width, max(target, width / SETTINGS.fastest)), rel=1e-12)
    first = narrowed(column(float("inf")), column(target), SETTINGS)
    assert float(first) == pytest.approx(target)


def test_the_noise_is_the_robust_sigma_of_the_inliers():
    generator = torch.Generator().manual_seed(0)
    cross = 0.3 * torch.randn(20000, 2, generator=generator, dtype=torch.float64)
    cross[::10] += 50.0
    r = Residuals(torch.zeros(1, 2).double(), cross, torch.ones(20000, dtype=torch.bool))
    assert noise_of(r, 0.9, SETTINGS) == pytest.approx(0.3, rel=0.03)
    exact = Residuals(r.own, torch.zeros_like(cross), r.cross_valid)
    assert noise_of(exact, 0.9, SETTINGS) == SETTINGS.noise_floor_px


def test_look_ups_that_see_obliquely_are_as_noisy_as_their_residuals_say():
    """Residuals three times as large below a cosine of 0.5: their kernel is as much wider, their weight smaller."""
    generator = torch.Generator().manual_seed(3)
    cosine = torch.rand(20_000, generator=generator, dtype=torch.float64)
    noise = torch.where(cosine < 0.5, 0.3, 0.1).double()
    cross = noise[:, None] * torch.randn(20_000, 2, generator=generator, dtype=torch.float64)
    r = Residuals(torch.zeros(1, 2).double(), cross, torch.ones(20_000, dtype=torch.bool))
    ratio = noise_ratios(r, cosine, SETTINGS)
    assert ratio[cosine < 0.48].median() / ratio[cosine > 0.52].median() == pytest.approx(3.0, rel=0.1)
    pair = torch.zeros(2, 20_000, dtype=torch.long)
    one = Kernel(torch.tensor([1.0], dtype=torch.float64), torch.tensor([0]), pair, ratio)
    exact = Residuals(r.own, torch.zeros_like(cross), r.cross_valid)
    assert torch.allclose(one.weights(exact)[1], 1 / ratio**2)


def test_without_any_look_up_all_count_alike():
    none = Residuals(torch.zeros(1, 2).double(), torch.zeros(3, 2).double(), torch.zeros(3, dtype=torch.bool))
    assert (noise_ratios(none, torch.rand(3).double(), SETTINGS) == 1).all()


def noisy(worse_below: float, factor: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Distances up to 40 pixels, and residuals that are larger near the border."""
    generator = torch.Generator().manual_seed(4)
    distance = (40 * torch.rand(20000, generator=generator, dtype=torch.float64)).floor()
    size = torch.randn(20000, 2, generator=generator, dtype=torch.float64).norm(dim=-1)
    return distance, torch.where(distance < worse_below, factor * size, size)


def test_look_ups_are_useful_from_where_residuals_are_no_larger_than_usual():
    """Classes are an eighth of all, five pixels wide."""
    assert useful_distance(*noisy(10, 2.0), SETTINGS) == pytest.approx(10, abs=1)
    assert useful_distance(*noisy(0, 1.0), SETTINGS) == 0
    assert useful_distance(torch.zeros(0), torch.zeros(0), SETTINGS) == 0


def test_at_most_half_of_the_look_ups_fall_away():
    distance, size = noisy(30, 3.0)
    least = useful_distance(distance, torch.where(distance < 20, 3 * size, size), SETTINGS)
    assert least == pytest.approx(20, abs=1)
    distance, size = noisy(0, 1.0)
    assert useful_distance(distance, torch.where(distance > 30, 9 * size, size), SETTINGS) == 0
