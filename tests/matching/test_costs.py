"""Costs against correlations written out, whatever else is tried."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from sl_nerfstudio.decoding.grid_fit import draw_sharpnesses
from sl_nerfstudio.matching.costs import (
    LEAST_IMAGE_VARIANCE,
    LEAST_PATTERN_VARIANCE,
    OUTSIDE,
    correlations,
    image_statistics,
    matching_costs,
)
from sl_nerfstudio.matching.lines import EpipolarLines
from tests.matching.scene import PATTERN, PERIOD, step_scene
from tests.matching.tiles import everything, is_tried, random_ranges, unpacked

SIGMA = 2.0


@pytest.fixture(scope="module")
def scene():
    return step_scene()


@pytest.fixture(scope="module")
def grid():
    return draw_sharpnesses(PATTERN.render(), PERIOD)[0]


def statistics_of(scene):
    return image_statistics(scene.image, np.ones(scene.image.shape, bool), SIGMA)


def costs_of(scene, w, grid, tried):
    cells = matching_costs(scene.image, statistics_of(scene), scene.lines, w, tried, grid, SIGMA)
    return unpacked(cells, tried, scene.image.shape, len(w), 0)


def all_costs(scene, w, grid):
    return costs_of(scene, w, grid, everything(scene.image.shape, len(w)))


def test_costs_are_correlations_in_gaussian_windows(scene, grid):
    statistics = statistics_of(scene)
    w = np.linspace(0.2, 0.3, 21)
    costs = all_costs(scene, w, grid)

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
    costs = all_costs(scene, w, grid)
    right = abs(w[costs.argmin(-1)] - scene.inverse_distance) < 2.5 * (w[1] - w[0])
    assert right[:95].mean() > 0.75 and right[125:].mean() > 0.75


@pytest.mark.parametrize("distortion", [0.0, 1e-3])
def test_what_is_tried_costs_the_same_whatever_else_is_tried(scene, grid, distortion):
    """Bit for bit: also at the border of the image, of tiles and of blocks of tiles, and in the general lens model."""
    projector = replace(scene.projector, k1=distortion)
    scene = replace(scene, lines=EpipolarLines.of(scene.camera, projector, scene.T_camera_projector))
    w, rng = np.linspace(0.22, 0.28, 9), np.random.default_rng(3)
    whole = all_costs(scene, w, grid)
    for _ in range(3):
        tried = random_ranges(rng, scene.image.shape, len(w))
        expected = np.where(is_tried(tried, scene.image.shape, len(w)), whole, 0)
        np.testing.assert_array_equal(costs_of(scene, w, grid, tried), expected)
