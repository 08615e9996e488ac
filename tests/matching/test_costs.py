"""Costs against correlations written out, and semi-global matching against the recursion of the paper."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from sl_nerfstudio.decoding.grid_fit import draw_sharpnesses
from sl_nerfstudio.matching import costs as costs_module
from sl_nerfstudio.matching.costs import (
    LEAST_IMAGE_VARIANCE,
    LEAST_PATTERN_VARIANCE,
    OUTSIDE,
    StereoMatches,
    correlations,
    image_statistics,
    match_semi_globally,
    matching_costs,
)
from sl_nerfstudio.matching.lines import UNKNOWN
from tests.matching.scene import PATTERN, PERIOD, step_scene

SIGMA = 2.0
SMALL, LARGE, STEEPEST, APART = 20, 90, 2, 1
WAYS = [(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1) if (r, c) != (0, 0)]


@pytest.fixture(scope="module")
def scene():
    return step_scene()


@pytest.fixture(scope="module")
def grid():
    return draw_sharpnesses(PATTERN.render(), PERIOD)[0]


def statistics_of(scene):
    return image_statistics(scene.image, np.ones(scene.image.shape, bool), SIGMA)


def test_costs_are_correlations_in_gaussian_windows(scene, grid):
    statistics = statistics_of(scene)
    w = np.linspace(0.2, 0.3, 21)  # more than are written at once
    costs = matching_costs(scene.image, statistics, scene.lines, w, grid, SIGMA)

    def mean(values):
        return gaussian_filter(values.astype(np.float64), SIGMA, mode="mirror", truncate=3.0)

    for k in (0, 7, 20):
        coords = scene.lines.at(np.full(scene.image.shape, w[k]))
        x, y = np.moveaxis(coords.astype(np.float64) - 0.5, -1, 0)
        inside = (x >= -0.5) & (y >= -0.5) & (x <= PATTERN.w - 0.5) & (y <= PATTERN.h - 0.5)
        assert (costs[..., k][~inside] == OUTSIDE).all()
        c, r = np.floor(x).astype(int).clip(0, PATTERN.w - 2), np.floor(y).astype(int).clip(0, PATTERN.h - 2)
        fx, fy, p = x - c, y - r, grid.layers[..., 0].astype(np.float64)
        drawn = (1 - fy) * ((1 - fx) * p[r, c] + fx * p[r, c + 1])
        drawn += fy * ((1 - fx) * p[r + 1, c] + fx * p[r + 1, c + 1])
        image = scene.image.astype(np.float64)
        variance = mean(image**2) - mean(image) ** 2
        variance = variance + LEAST_IMAGE_VARIANCE * np.median(variance)
        spread = mean(drawn**2) - mean(drawn) ** 2 + LEAST_PATTERN_VARIANCE
        correlation = (mean(drawn * image) - mean(drawn) * mean(image)) / np.sqrt(spread * variance)
        deep = np.zeros_like(inside)
        deep[9:190, 9:190] = inside[9:190, 9:190]
        np.testing.assert_allclose(costs[..., k][deep], (127 * (1 - correlation))[deep], atol=4)
        direct = correlations(scene.image, statistics, coords, grid, SIGMA)
        np.testing.assert_allclose(direct[deep], correlation[deep], atol=0.03)


def test_the_right_inverse_distance_costs_least_where_the_pattern_tells(scene, grid):
    w = np.linspace(scene.inverse_distance.min(), scene.inverse_distance.max(), 60)
    costs = matching_costs(scene.image, statistics_of(scene), scene.lines, w, grid, SIGMA)
    right = abs(w[costs.argmin(-1)] - scene.inverse_distance) < 2.5 * (w[1] - w[0])
    assert right[:95].mean() > 0.75 and right[125:].mean() > 0.75


def nothing_decoded(costs):
    return np.full(costs.shape[:2], UNKNOWN, np.int32)


def sums_by_the_paper(costs, decoded):
    """Equations 13 and 14 of Hirschmueller (2008), for every pixel, way and step by itself; with a known slope."""
    h, w, count = costs.shape
    total = np.zeros(costs.shape, np.int64)
    for down, right in WAYS:
        along: dict[tuple[int, int], list[int]] = {}
        rows = range(h) if down >= 0 else range(h - 1, -1, -1)
        columns = range(w) if right >= 0 else range(w - 1, -1, -1)
        for row in rows:
            for column in columns:
                before = along.get((row - down, column - right))
                slope = 0
                if before is not None and abs(decoded[row, column] - decoded[row - down, column - right]) <= STEEPEST:
                    slope = decoded[row, column] - decoded[row - down, column - right]
                here = []
                for k in range(count):
                    value = int(costs[row, column, k])
                    if before is not None:
                        ways = [min(before) + LARGE]
                        steps = [(k - slope, 0), (k - slope - 1, SMALL), (k - slope + 1, SMALL)]
                        ways += [before[j] + change for j, change in steps if 0 <= j < count]
                        value += min(ways) - min(before)
                    here.append(value)
                along[row, column] = here
        for (row, column), values in along.items():
            total[row, column] += values
    return total


@pytest.mark.parametrize("known", [0.0, 0.8])
@pytest.mark.parametrize("shape", [(6, 7, 5), (1, 9, 4), (8, 1, 3), (5, 4, 17)])
def test_the_best_match_is_that_of_the_paper(monkeypatch, shape, known):
    for name in ("SMALL", "LARGE", "STEEPEST", "APART"):
        monkeypatch.setattr(costs_module, name, globals()[name])
    rng = np.random.default_rng(sum(shape))
    costs = rng.integers(0, 256, shape).astype(np.uint8)
    decoded = np.where(rng.random(shape[:2]) < known, rng.integers(0, shape[2], shape[:2]), UNKNOWN).astype(np.int32)
    total = sums_by_the_paper(costs, decoded)
    best = total.argmin(-1)
    found = match_semi_globally(costs, decoded)
    rivals = np.where(abs(np.arange(shape[2]) - best[..., None]) > APART, total, 65535)
    np.testing.assert_array_equal(found.margin, rivals.min(-1) - total.min(-1))
    np.testing.assert_array_equal(found.cost, np.take_along_axis(costs, best[..., None], -1)[..., 0])
    assert abs(found.index - best).max() <= 2  # at either end a parabola is taken one step inside
    inside = (best > 0) & (best < shape[2] - 1)
    a, b, c = (np.take_along_axis(total, (best.clip(1, shape[2] - 2) + k)[..., None], -1)[..., 0] for k in (-1, 0, 1))
    bend = a - 2 * b + c
    expected = best + np.where(bend > 0, (a - c) / np.maximum(2 * bend, 1), 0)
    np.testing.assert_allclose(found.index[inside], expected[inside], atol=1e-5)
    parts = StereoMatches.joined([found.part(slice(0, shape[0] // 2)), found.part(slice(shape[0] // 2, None))])
    for name in ("index", "cost", "margin"):
        np.testing.assert_array_equal(getattr(parts, name), getattr(found, name))


def test_a_slope_is_followed_through_pixels_that_show_nothing():
    """A plane in steps, with noise and a stripe without any evidence."""
    rng = np.random.default_rng(4)
    row, column = np.mgrid[:40, :60]
    true = (column / 4 + row / 8 + 3).astype(int)
    costs = rng.integers(90, 160, (40, 60, 32))
    np.put_along_axis(costs, true[..., None], 20, axis=-1)
    costs[15:19] = 127
    costs = costs.astype(np.uint8)
    found = match_semi_globally(costs, nothing_decoded(costs))
    assert abs(found.index - true).max() < 2.5 and abs(found.index - true).mean() < 0.6
    assert np.median(found.margin[15:19]) < np.median(found.margin[:10])


def test_a_steep_surface_is_followed_where_it_was_decoded():
    """Three steps a pixel: every change would be one of the costly kind, and the pixel's own evidence is weak."""
    rng = np.random.default_rng(6)
    true = np.broadcast_to(3 * np.arange(30) + 5, (25, 30)).astype(np.int32)
    costs = rng.integers(60, 180, (25, 30, 100))
    np.put_along_axis(costs, true[..., None], 75, axis=-1)
    costs = costs.astype(np.uint8)
    with_slope = match_semi_globally(costs, true + 7)  # the slope counts, not the place
    without = match_semi_globally(costs, nothing_decoded(costs))
    assert (abs(with_slope.index - true) < 1.5).mean() > 0.97 > 0.75 > (abs(without.index - true) < 1.5).mean()
