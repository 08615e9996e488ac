"""Values computed by hand, invariances, and insensitivity to gross errors."""

import pytest
import torch

from sl_nerfstudio.rendering.losses import (
    behind_loss,
    coordinate_loss,
    eikonal_loss,
    facing_loss,
    free_space_loss,
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


@pytest.mark.parametrize("factor", [1e-3, 0.5, 40.0])
def test_the_pattern_matches_up_to_intensity(factor):
    a, b = torch.rand(2, 100, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert float(pattern_loss(factor * a, b)) == pytest.approx(float(pattern_loss(a, b)), abs=1e-12)
    assert float(pattern_loss(a, factor * b)) == pytest.approx(float(pattern_loss(a, b)), abs=1e-12)
    assert float(pattern_loss(factor * a, a)) == pytest.approx(0, abs=1e-12)
    assert 0 < float(pattern_loss(a, b)) < 1
    assert float(pattern_loss(torch.tensor([1.0, 0.0]), torch.tensor([0.0, 1.0]))) == 1


def test_a_dark_batch_gives_no_nan():
    dark = torch.zeros(10, requires_grad=True)
    pattern_loss(dark, torch.rand(10)).backward()
    assert dark.grad is not None and dark.grad.isfinite().all()


def test_slope_one_costs_nothing():
    gradient = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    assert float(eikonal_loss(gradient, ALL)) < 1e-12
    assert float(eikonal_loss(3 * gradient, ALL)) == pytest.approx(4, rel=1e-5)
    assert float(eikonal_loss(0.5 * gradient, ALL)) == pytest.approx(0.25, rel=1e-5)


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


def test_weights_of_measured_points_are_shares():
    sdf = torch.tensor([0.02, 0.5], dtype=torch.float64)
    weight = torch.tensor([3.0, 1.0], dtype=torch.float64)
    loss = surface_loss(sdf, weight, 0.1)
    assert float(surface_loss(sdf, 7 * weight, 0.1)) == pytest.approx(float(loss))
    assert float(surface_loss(sdf, torch.tensor([3.0, 0.0], dtype=torch.float64), 0.1)) == pytest.approx(
        float(surface_loss(sdf[:1], weight[:1], 0.1))
    )
    assert float(surface_loss(sdf, 0 * weight, 0.1)) == 0


def test_signs_in_front_of_the_surface_and_behind():
    sdf, least = torch.tensor([0.5, 0.1, -0.2]), torch.tensor([0.2, 0.2, 0.1])
    counts = torch.tensor([True, True, True])
    assert float(free_space_loss(sdf, least, counts)) == pytest.approx((0 + 0.1 + 0.3) / 3)
    assert float(behind_loss(sdf, counts)) == pytest.approx(0.6 / 3)
    assert float(behind_loss(-sdf.abs(), counts)) == 0


def test_points_that_do_not_count_are_as_if_they_were_not_there():
    sdf, least = torch.tensor([0.5, 0.1, -0.2]), torch.tensor([0.2, 0.2, 0.1])
    gradient = torch.tensor([[2.0, 0, 0], [0, 1, 0], [0, 0, 3]])
    counts = torch.tensor([True, False, True])
    assert free_space_loss(sdf, least, counts) == free_space_loss(sdf[counts], least[counts], ALL[:2])
    assert behind_loss(sdf, counts) == behind_loss(sdf[counts], ALL[:2])
    assert eikonal_loss(gradient, counts) == eikonal_loss(gradient[counts], ALL[:2]) == 2.5
    assert eikonal_loss(gradient, ~ALL[:3]) == 0


def test_a_surface_may_be_grazed_but_not_seen_from_inside():
    direction = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64).expand(4, 3)
    gradient = torch.tensor([[0.0, 0, -1], [1, 0, -0.05], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    weight = torch.tensor([1.0, 1.0, 2.0, 1.0], dtype=torch.float64)
    assert float(facing_loss(gradient, direction, weight)) == pytest.approx((2 * 0.05 + 1.05) / 5)
    assert float(facing_loss(gradient[:2], direction[:2], weight[:2])) == pytest.approx(0, abs=1e-12)
    assert float(facing_loss(gradient, direction, 0 * weight)) == 0
