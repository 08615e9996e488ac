"""Semi-global matching against the recursion of the paper, written out."""

import numpy as np
import pytest

from sl_nerfstudio.matching.costs import UNKNOWN, StereoMatches, match_semi_globally
from sl_nerfstudio.matching.lines import SmoothnessSettings

SMOOTHNESS = SmoothnessSettings(small=20, large=90, steepest=2, apart=1)
WAYS = [(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1) if (r, c) != (0, 0)]


def nothing_decoded(costs):
    return np.full(costs.shape[:2], UNKNOWN, np.int32)


def sums_by_the_paper(costs, decoded, small, large, steepest):
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
                if before is not None and abs(decoded[row, column] - decoded[row - down, column - right]) <= steepest:
                    slope = decoded[row, column] - decoded[row - down, column - right]
                here = []
                for k in range(count):
                    value = int(costs[row, column, k])
                    if before is not None:
                        ways = [min(before) + large]
                        steps = [(k - slope, 0), (k - slope - 1, small), (k - slope + 1, small)]
                        ways += [before[j] + change for j, change in steps if 0 <= j < count]
                        value += min(ways) - min(before)
                    here.append(value)
                along[row, column] = here
        for (row, column), values in along.items():
            total[row, column] += values
    return total


@pytest.mark.parametrize("known", [0.0, 0.8])
@pytest.mark.parametrize("shape", [(6, 7, 5), (1, 9, 4), (8, 1, 3), (5, 4, 17)])
def test_the_best_match_is_that_of_the_paper(shape, known):
    rng = np.random.default_rng(sum(shape))
    costs = rng.integers(0, 256, shape).astype(np.uint8)
    decoded = np.where(rng.random(shape[:2]) < known, rng.integers(0, shape[2], shape[:2]), UNKNOWN).astype(np.int32)
    total = sums_by_the_paper(costs, decoded, SMOOTHNESS.small, SMOOTHNESS.large, SMOOTHNESS.steepest)
    best = total.argmin(-1)
    found = match_semi_globally(costs, decoded, SMOOTHNESS)
    lowest = total.min(-1)
    rivals = np.where(abs(np.arange(shape[2]) - best[..., None]) > SMOOTHNESS.apart, total, 65535)
    np.testing.assert_array_equal(found.margin, rivals.min(-1) - lowest)
    np.testing.assert_array_equal(found.cost, np.take_along_axis(costs, best[..., None], -1)[..., 0])
    assert abs(found.index - best).max() <= 2  # at either end a parabola is taken one step inside
    inside = (best > 0) & (best < shape[2] - 1)
    a, b, c = (np.take_along_axis(total, (best.clip(1, shape[2] - 2) + k)[..., None], -1)[..., 0] for k in (-1, 0, 1))
    bend = a - 2 * b + c
    expected = best + np.where(bend > 0, (a - c) / np.maximum(2 * bend, 1), 0)
    np.testing.assert_allclose(found.index[inside], expected[inside], atol=1e-5)


def test_a_slope_is_followed_through_pixels_that_show_nothing():
    """A plane in steps, with noise and a stripe without any evidence."""
    rng = np.random.default_rng(4)
    row, column = np.mgrid[:40, :60]
    true = (column / 4 + row / 8 + 3).astype(int)
    costs = rng.integers(90, 160, (40, 60, 32))
    np.put_along_axis(costs, true[..., None], 20, axis=-1)
    costs[15:19] = 127
    costs = costs.astype(np.uint8)
    found = match_semi_globally(costs, nothing_decoded(costs), SmoothnessSettings())
    assert abs(found.index - true).max() < 2.5 and abs(found.index - true).mean() < 0.6
    assert np.median(found.margin[15:19]) < np.median(found.margin[:10])


def test_a_steep_surface_is_followed_where_it_was_decoded():
    """Three steps a pixel: every change would be one of the costly kind, and the pixel's own evidence is weak."""
    rng = np.random.default_rng(6)
    true = np.broadcast_to(3 * np.arange(30) + 5, (25, 30)).astype(np.int32)
    costs = rng.integers(60, 180, (25, 30, 100))
    np.put_along_axis(costs, true[..., None], 75, axis=-1)
    costs = costs.astype(np.uint8)
    with_slope = match_semi_globally(costs, true + 7, SmoothnessSettings())  # the slope counts, not the place
    without = match_semi_globally(costs, nothing_decoded(costs), SmoothnessSettings())
    assert (abs(with_slope.index - true) < 1.5).mean() > 0.97 > 0.75 > (abs(without.index - true) < 1.5).mean()


def test_strips_are_joined_in_order():
    costs = np.random.default_rng(0).integers(0, 256, (9, 5, 6)).astype(np.uint8)
    whole = match_semi_globally(costs, nothing_decoded(costs), SMOOTHNESS)
    joined = StereoMatches.joined([whole.part(slice(0, 4)), whole.part(slice(4, 9))])
    np.testing.assert_array_equal(joined.index, whole.index)
    np.testing.assert_array_equal(joined.margin, whole.margin)
