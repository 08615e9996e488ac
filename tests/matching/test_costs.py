"""Costs and the inverse distances for which they are computed, on a scene that is known."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from sl_nerfstudio.decoding.grid_fit import draw_sharpnesses
from sl_nerfstudio.matching.costs import (
    OUTSIDE,
    correlations,
    hypotheses,
    image_statistics,
    matching_costs,
    with_offset,
)
from sl_nerfstudio.matching.lines import CostSettings, HypothesisSettings
from tests.matching.scene import PATTERN, PERIOD, step_scene

SIGMA = 2.0
COSTS, HYPOTHESES = CostSettings(), HypothesisSettings()


@pytest.fixture(scope="module")
def scene():
    return step_scene()


@pytest.fixture(scope="module")
def grid():
    return draw_sharpnesses(PATTERN.render(), PERIOD)[0]


def everywhere(scene):
    return np.ones(scene.image.shape, bool)


def test_costs_are_correlations_in_gaussian_windows(scene, grid):
    statistics = image_statistics(scene.image, everywhere(scene), SIGMA, COSTS)
    w = np.linspace(0.2, 0.3, 21)  # more than are written at once
    costs = matching_costs(scene.image, statistics, scene.lines, w, grid, SIGMA, COSTS)

    def mean(values):
        return gaussian_filter(values.astype(np.float64), SIGMA, mode="mirror", truncate=3.0)

    for k in (0, 7, 20):
        coords = scene.lines.at(np.full(scene.image.shape, w[k]))
        x, y = np.moveaxis(coords.astype(np.float64) - 0.5, -1, 0)
        inside = (x >= -0.5) & (y >= -0.5) & (x <= PATTERN.w - 0.5) & (y <= PATTERN.h - 0.5)
        assert (costs[..., k][~inside] == OUTSIDE).all()
        c, r = np.floor(x).astype(int).clip(0, PATTERN.w - 2), np.floor(y).astype(int).clip(0, PATTERN.h - 2)
        fx, fy, p = x - c, y - r, grid.layers[..., 0].astype(np.float64)
        drawn = (1 - fy) * ((1 - fx) * p[r, c] + fx * p[r, c + 1]) + fy * (
            (1 - fx) * p[r + 1, c] + fx * p[r + 1, c + 1]
        )
        image = scene.image.astype(np.float64)
        common = mean(drawn * image) - mean(drawn) * mean(image)
        variance = mean(image**2) - mean(image) ** 2
        variance = variance + COSTS.least_image_variance * np.median(variance)
        spread = mean(drawn**2) - mean(drawn) ** 2 + COSTS.least_pattern_variance
        correlation = common / np.sqrt(spread * variance)
        deep = inside & (np.arange(200)[:, None] > 8) & (np.arange(200) > 8) & (np.arange(200) < 190)
        deep &= np.arange(200)[:, None] < 190
        np.testing.assert_allclose(costs[..., k][deep], (127 * (1 - correlation))[deep], atol=4)
        direct = correlations(scene.image, statistics, coords, grid, SIGMA, COSTS)
        np.testing.assert_allclose(direct[deep], correlation[deep], atol=0.03)


def test_the_right_inverse_distance_costs_least_where_the_pattern_tells(scene, grid):
    statistics = image_statistics(scene.image, everywhere(scene), SIGMA, COSTS)
    w = np.linspace(scene.inverse_distance.min(), scene.inverse_distance.max(), 60)
    costs = matching_costs(scene.image, statistics, scene.lines, w, grid, SIGMA, COSTS)
    right = abs(w[costs.argmin(-1)] - scene.inverse_distance) < 2.5 * (w[1] - w[0])
    assert right[:95].mean() > 0.75 and right[125:].mean() > 0.75


@pytest.mark.parametrize("seen", [1.0, 0.3])
def test_the_range_holds_all_distances_and_steps_are_a_tenth_of_a_period(scene, seen):
    coords = scene.coords.copy()
    coords[:, round(200 * seen) :] = np.nan
    w = hypotheses(scene.lines, coords, scene.lines.nearest(coords), everywhere(scene), PERIOD, HYPOTHESES)
    assert w[0] < scene.inverse_distance.min() and w[-1] > scene.inverse_distance.max()
    step = np.linalg.norm(scene.lines.slopes(scene.inverse_distance), axis=-1) * (w[1] - w[0])
    assert np.median(step) == pytest.approx(0.1 * PERIOD, rel=0.1)


def test_without_anything_near_its_line_there_is_no_range(scene):
    coords = np.full_like(scene.coords, np.nan)
    w = scene.lines.nearest(coords)
    assert hypotheses(scene.lines, coords, w, everywhere(scene), PERIOD, HYPOTHESES) is None


def test_lines_are_moved_to_what_was_decoded_and_wrong_coordinates_do_not_count(scene):
    slope = scene.lines.slopes(scene.inverse_distance)
    across = np.stack([-slope[..., 1], slope[..., 0]], -1) / np.linalg.norm(slope, axis=-1, keepdims=True)
    coords = (scene.coords + 0.8 * across).astype(np.float32)
    wild = np.random.default_rng(0).random(coords.shape[:2]) < 0.1
    coords[wild] += (40 * across[wild]).astype(np.float32)
    moved = with_offset(scene.lines, coords, PERIOD, 15.0, HYPOTHESES)
    found = ((moved.offset - scene.lines.offset) * across).sum(-1)
    assert abs(np.median(found) - 0.8) < 0.08  # the prior holds back a twentieth
    again = with_offset(moved, scene.coords, PERIOD, 15.0, HYPOTHESES)
    assert abs(np.median(((again.offset - scene.lines.offset) * across).sum(-1))) < 0.08
