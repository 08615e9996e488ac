"""Which inverse distances are tried where, and their costs against correlations written out."""

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
from sl_nerfstudio.matching.lines import UNKNOWN, EpipolarLines
from sl_nerfstudio.matching.ranges import FEWEST, LEAST_DECODED, MARGIN, TILE, TriedRanges
from tests.matching.scene import PATTERN, PERIOD, step_scene
from tests.matching.tiles import everything, is_tried, random_ranges, unpacked

SIGMA = 2.0


@pytest.fixture(scope="module")
def scene():
    return step_scene()


@pytest.fixture(scope="module")
def grid():
    return draw_sharpnesses(PATTERN.render(), PERIOD)[0]


def costs_of(scene, w, grid, tried=None):
    tried = everything(scene.image.shape, len(w)) if tried is None else tried
    statistics = image_statistics(scene.image, np.ones(scene.image.shape, bool), SIGMA)
    cells = matching_costs(scene.image, statistics, scene.lines, w, tried, grid, SIGMA)
    return statistics, unpacked(cells, tried, scene.image.shape, len(w))


def test_costs_are_correlations_in_gaussian_windows(scene, grid):
    w = np.linspace(0.2, 0.3, 21)
    statistics, costs = costs_of(scene, w, grid)

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
    _, costs = costs_of(scene, w, grid)
    right = abs(w[costs.argmin(-1)] - scene.inverse_distance) < 2.5 * (w[1] - w[0])
    assert right[:95].mean() > 0.75 and right[125:].mean() > 0.75


@pytest.mark.parametrize("distortion", [0.0, 1e-3])
def test_what_is_tried_costs_the_same_whatever_else_is_tried(scene, grid, distortion):
    """Bit for bit: also at the border of the image, of tiles and of blocks of tiles, and in the general lens model."""
    projector = replace(scene.projector, k1=distortion)
    scene = replace(scene, lines=EpipolarLines.of(scene.camera, projector, scene.T_camera_projector))
    w, rng = np.linspace(0.22, 0.28, 9), np.random.default_rng(3)
    _, whole = costs_of(scene, w, grid)
    for _ in range(3):
        tried = random_ranges(rng, scene.image.shape, len(w))
        expected = np.where(is_tried(tried, scene.image.shape, len(w)), whole, 0)
        np.testing.assert_array_equal(costs_of(scene, w, grid, tried)[1], expected)


@pytest.mark.parametrize("shape, count", [((70, 50), 60), ((16, 16), 3), ((5, 90), 17), ((33, 32), 200)])
def test_ranges_span_what_was_decoded_around_a_tile(shape, count):
    rng = np.random.default_rng(sum(shape))
    decoded = (count / 2 + count / 9 * rng.normal(size=shape)).astype(np.int32).clip(0, count - 1)
    share = np.kron(rng.choice([0, 0.5, 0.95, 1], tuple(-(-n // 8) for n in shape)), np.ones((8, 8)))
    decoded[rng.random(shape) > share[: shape[0], : shape[1]]] = UNKNOWN
    mask = np.arange(shape[1])[None] < np.full((shape[0], 1), 0.6 * shape[1])
    tried = TriedRanges.near(decoded, mask, count)
    for a, b in np.ndindex(tried.first.shape):
        around = tuple(slice(max(k - 1, 0) * TILE, (k + 2) * TILE) for k in (a, b))
        seen = mask[around] | (decoded[around] != UNKNOWN)
        numbers = decoded[around][decoded[around] != UNKNOWN]
        first, last = tried.first[a, b], tried.first[a, b] + tried.count[a, b] - 1
        if not seen.any():
            assert tried.count[a, b] == 0
        elif len(numbers) == 0 or len(numbers) < LEAST_DECODED * seen.sum():
            assert (first, last) == (0, count - 1)
        else:
            assert first == min(max(numbers.min() - MARGIN, 0), count - FEWEST)
            assert last == max(min(numbers.max() + MARGIN, count - 1), first + FEWEST - 1)
