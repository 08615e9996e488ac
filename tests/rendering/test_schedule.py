"""Sharpness and levels over a run: end points, monotonicity, switches."""

from itertools import pairwise

import pytest
import torch

from sl_nerfstudio.rendering.losses import AnnealingConfig, kappa_at, level_weights_at

TOTAL, LEVELS = 1000, 8


@pytest.mark.parametrize("growth", ["geometric", "linear"])
def test_sharpness_grows_from_start_to_end(growth):
    config = AnnealingConfig(kappa_start=10.0, kappa_end=90.0, kappa_growth=growth, kappa_per_step=0.1)
    values = [kappa_at(config, step, TOTAL) for step in range(0, TOTAL + 200, 10)]
    assert values[0] == pytest.approx(10) and values[-1] == pytest.approx(90)
    assert kappa_at(config, TOTAL, TOTAL) == pytest.approx(90)
    assert all(b >= a for a, b in pairwise(values)) and max(values) <= 90 * (1 + 1e-12)
    assert kappa_at(config, 500, TOTAL) == pytest.approx(30 if growth == "geometric" else 60)


def test_linear_growth_does_not_depend_on_the_length_of_the_run():
    config = AnnealingConfig(kappa_start=10.0, kappa_end=1e6, kappa_growth="linear", kappa_per_step=0.02)
    assert {kappa_at(config, 100, total) for total in (1, 100, 10**6)} == {12.0}


def test_without_annealing_sharpness_is_the_final_one():
    config = AnnealingConfig(anneal_kappa=False, kappa_growth="linear")
    assert {kappa_at(config, step, TOTAL) for step in (0, 5, TOTAL, 3 * TOTAL)} == {config.kappa_end}


def weights(config: AnnealingConfig, step: int, total: int = TOTAL) -> torch.Tensor:
    return level_weights_at(config, LEVELS, step, total)


def test_levels_fade_in_one_after_the_other():
    config = AnnealingConfig(levels_at_start=2, all_levels_at=0.4)
    table = torch.stack([weights(config, step) for step in range(0, 600, 5)])
    assert torch.equal(table[0], torch.tensor([1.0, 1.0] + [0.0] * 6))
    assert torch.equal(table[80:], torch.ones_like(table[80:]))  # step 400 and after
    assert not torch.equal(table[79], torch.ones(LEVELS))
    assert (table.diff(dim=0) >= 0).all() and (table.diff(dim=1) <= 0).all()
    assert table.min() >= 0 and table.max() <= 1
    assert ((table > 0) & (table < 1)).sum(1).max() == 1  # one at a time


def test_a_level_half_way_has_half_its_weight():
    config = AnnealingConfig(levels_at_start=2, all_levels_at=0.6)
    assert float(weights(config, 50)[2]) == pytest.approx(0.5, abs=1e-6)


@pytest.mark.parametrize(
    "config, step, total",
    [
        (AnnealingConfig(coarse_to_fine=False), 0, TOTAL),
        (AnnealingConfig(levels_at_start=LEVELS), 0, TOTAL),
        (AnnealingConfig(levels_at_start=LEVELS + 5), 0, TOTAL),
        (AnnealingConfig(all_levels_at=0.0), 1, TOTAL),
        (AnnealingConfig(), 1, 0),
    ],
)
def test_all_levels_at_once(config, step, total):
    assert torch.equal(weights(config, step, total), torch.ones(LEVELS))
