"""Losses by hand, invariances, insensitivity to gross errors; sharpness and levels over a run."""

from itertools import pairwise

import pytest
import torch

from sl_nerfstudio.rendering.losses import (
    AnnealingConfig,
    behind_loss,
    coordinate_loss,
    eikonal_loss,
    facing_loss,
    free_space_loss,
    kappa_at,
    level_weights_at,
    pattern_loss,
    surface_loss,
)

NAN = float("nan")
ALL = torch.ones(50, dtype=torch.bool)


def test_coordinates_count_by_their_l1_distance_where_they_are_known():
    rendered = torch.tensor([[1.0, 2.0], [5.0, 5.0], [0.0, 0.0]], requires_grad=True)
    measured = torch.tensor([[2.0, 0.0], [NAN, NAN], [4.0, -4.0]])
    counts = torch.tensor([True, False, True])
    loss = coordinate_loss(rendered, measured, counts)
    assert loss.item() == pytest.approx((3 + 8) / 2)
    loss.backward()
    assert rendered.grad is not None
    assert torch.equal(rendered.grad, torch.tensor([[-0.5, 0.5], [0.0, 0.0], [-0.5, 0.5]]))
    assert coordinate_loss(rendered, measured, torch.zeros(3, dtype=torch.bool)).item() == 0


def test_the_pattern_matches_up_to_intensity():
    a, b = torch.rand(2, 100, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected = 1 - float(a @ b / (a.norm() * b.norm()))
    for factor in (1e-3, 1.0, 40.0):
        assert float(pattern_loss(factor * a, b)) == pytest.approx(expected, abs=1e-12)
        assert float(pattern_loss(a, factor * b)) == pytest.approx(expected, abs=1e-12)
    dark = torch.zeros(10, requires_grad=True)
    pattern_loss(dark, torch.rand(10)).backward()
    assert dark.grad is not None and dark.grad.isfinite().all()


def test_slope_one_costs_nothing():
    gradient = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    assert float(eikonal_loss(gradient, ALL)) < 1e-12
    assert float(eikonal_loss(3 * gradient, ALL)) == pytest.approx(4, rel=1e-5)
    counts = ALL.clone()
    counts[25:] = False  # points that do not count are as if they were not there
    assert float(eikonal_loss(torch.cat([0.5 * gradient[:25], 9 * gradient[25:]]), counts)) == pytest.approx(
        0.25, rel=1e-5
    )
    assert eikonal_loss(gradient, ~ALL) == 0


def test_measured_points_attract_the_surface_when_near_and_not_when_far():
    width = 0.1
    sdf = torch.tensor([1e-4, -1e-4, 0.1, 1.0, -3.0], dtype=torch.float64, requires_grad=True)
    one = torch.ones(5, dtype=torch.float64)
    loss = surface_loss(sdf, one, width)
    loss.backward()
    assert sdf.grad is not None
    pull = 5 * sdf.grad
    assert pull[:2].tolist() == pytest.approx([1, -1], rel=2e-3)
    assert float(pull[2]) == pytest.approx(float(torch.exp(torch.tensor(-1.0))), rel=1e-6)
    assert pull[3].abs() < 1e-4 and pull[4].abs() < 1e-12
    assert loss.item() < width
    sdf, weight = sdf.detach(), torch.tensor([3.0, 0.0, 0.0, 1.0, 0.0], dtype=torch.float64)  # weights are shares
    expected = (3 * surface_loss(sdf[:1], one[:1], width) + surface_loss(sdf[3:4], one[:1], width)) / 4
    for factor in (1.0, 7.0):
        assert float(surface_loss(sdf, factor * weight, width)) == pytest.approx(float(expected))
    assert float(surface_loss(sdf, 0 * weight, width)) == 0


def test_signs_in_front_of_the_surface_and_behind():
    sdf, least = torch.tensor([0.5, 0.1, -0.2]), torch.tensor([0.2, 0.2, 0.1])
    counts = torch.tensor([True, True, True])
    assert float(free_space_loss(sdf, least, counts)) == pytest.approx((0 + 0.1 + 0.3) / 3)
    assert float(behind_loss(sdf, counts)) == pytest.approx(0.6 / 3)
    assert float(behind_loss(-sdf.abs(), counts)) == 0
    counts[1] = False
    assert (
        float(free_space_loss(sdf, least, counts)) == pytest.approx(0.3 / 2) and float(behind_loss(sdf, counts)) == 0.25
    )


def test_a_surface_may_be_grazed_but_not_seen_from_inside():
    direction = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64).expand(4, 3)
    gradient = torch.tensor([[0.0, 0, -1], [1, 0, -0.05], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    weight = torch.tensor([1.0, 1.0, 2.0, 1.0], dtype=torch.float64)
    assert float(facing_loss(gradient, direction, weight)) == pytest.approx((2 * 0.05 + 1.05) / 5)
    assert float(facing_loss(gradient[:2], direction[:2], weight[:2])) == pytest.approx(0, abs=1e-12)
    assert float(facing_loss(gradient, direction, 0 * weight)) == 0


TOTAL, LEVELS = 1000, 8


@pytest.mark.parametrize(("growth", "half_way", "end"), [("geometric", 12800**0.5, 400), ("linear", 42, 200)])
def test_sharpness_grows_from_start_to_end(growth, half_way, end):
    values = [kappa_at(growth, step, TOTAL) for step in range(0, 10 * TOTAL, 10)]
    assert values[0] == pytest.approx(32) and values[-1] == max(values) == pytest.approx(end)
    assert all(b >= a for a, b in pairwise(values))
    assert kappa_at(growth, 500, TOTAL) == pytest.approx(half_way)
    assert {kappa_at("linear", 100, total) for total in (1, 100, 10**6)} == {34.0}
    assert {kappa_at("constant", step, TOTAL) for step in (0, 5, 3 * TOTAL)} == {32.0}


def test_levels_fade_in_one_after_the_other():
    table = torch.stack([level_weights_at(AnnealingConfig(), LEVELS, step, TOTAL) for step in range(0, 600, 5)])
    assert torch.equal(table[0], torch.tensor([1.0, 1.0] + [0.0] * 6))
    assert torch.equal(table[80:], torch.ones_like(table[80:]))  # step 400 and after
    assert not torch.equal(table[79], torch.ones(LEVELS))
    assert (table.diff(dim=0) >= 0).all() and (table.diff(dim=1) <= 0).all()
    assert table.min() >= 0 and table.max() <= 1
    assert ((table > 0) & (table < 1)).sum(1).max() == 1  # one at a time
    at_once = (AnnealingConfig(coarse_to_fine=False), LEVELS, 0, TOTAL), (AnnealingConfig(), 2, 0, TOTAL)
    for arguments in (*at_once, (AnnealingConfig(), LEVELS, 1, 0)):
        assert (level_weights_at(*arguments) == 1).all()
