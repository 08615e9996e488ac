"""Semi-global matching against the recursion of the paper, in what is tried."""

import numpy as np
import pytest

from sl_nerfstudio.matching.lines import UNKNOWN
from sl_nerfstudio.matching.semi_global import APART, LARGE, SMALL, STEEPEST, StereoMatches, match_semi_globally
from tests.matching.tiles import everything, is_tried, packed, random_ranges

WAYS = [(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1) if (r, c) != (0, 0)]
NEVER = 10**6


def sums_by_the_paper(costs, decoded):
    """Equations 13 and 14 of Hirschmueller (2008), for every pixel, way and step by itself; with a known slope.

    What costs `NEVER` is not tried: no way leads there, and where no way came from, one begins.
    """
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
                    if before is not None and min(before) < NEVER:
                        ways = [min(before) + LARGE]
                        steps = [(k - slope, 0), (k - slope - 1, SMALL), (k - slope + 1, SMALL)]
                        ways += [before[j] + change for j, change in steps if 0 <= j < count]
                        value += min(ways) - min(before)
                    here.append(min(value, NEVER))
                along[row, column] = here
        for (row, column), values in along.items():
            total[row, column] += values
    return total


@pytest.mark.parametrize("known", [0.0, 0.8])
@pytest.mark.parametrize("whole", [True, False])
@pytest.mark.parametrize("shape", [(6, 7, 5), (1, 9, 4), (8, 1, 3), (5, 4, 17), (33, 18, 9), (17, 50, 12)])
def test_the_best_match_is_that_of_the_paper(shape, whole, known):
    rng, count = np.random.default_rng(sum(shape)), shape[2]
    costs = rng.integers(0, 256, shape).astype(np.uint8)
    decoded = np.where(rng.random(shape[:2]) < known, rng.integers(0, count, shape[:2]), UNKNOWN).astype(np.int32)
    tried = everything(shape[:2], count) if whole else random_ranges(rng, shape[:2], count)
    inside = is_tried(tried, shape[:2], count)
    total = np.where(inside, sums_by_the_paper(np.where(inside, costs.astype(int), NEVER), decoded), NEVER)
    found = match_semi_globally(packed(costs, tried), tried, decoded)
    some = inside.any(-1)
    assert np.isnan(found.index[~some]).all() and (found.margin[~some] == 0).all()
    best = total.argmin(-1)
    rivals = np.where(abs(np.arange(count) - best[..., None]) > APART, total, NEVER).min(-1)
    expected = np.minimum(rivals - total.min(-1), 8 * LARGE)
    np.testing.assert_array_equal(found.margin[some], expected[some])
    np.testing.assert_array_equal(found.cost[some], np.take_along_axis(costs, best[..., None], -1)[..., 0][some])
    low, high = inside.argmax(-1), count - 1 - inside[..., ::-1].argmax(-1)
    assert abs(found.index - best)[some].max(initial=0) <= 2  # at either end a parabola is taken one step inside
    within = some & (best > low) & (best < high)
    a, b, c = (np.take_along_axis(total, (best.clip(1, count - 2) + k)[..., None], -1)[..., 0] for k in (-1, 0, 1))
    bend = a - 2 * b + c
    peak = best + np.where(bend > 0, (a - c) / np.maximum(2 * bend, 1), 0)
    np.testing.assert_allclose(found.index[within], peak[within], atol=1e-5)
    parts = StereoMatches.joined([found.part(slice(0, shape[0] // 2)), found.part(slice(shape[0] // 2, None))])
    for name in ("index", "cost", "margin"):
        np.testing.assert_array_equal(getattr(parts, name), getattr(found, name))


def match(true, cost, among, decoded, hidden=slice(0)):
    """Matches where the true ones have a cost, and all others one `among` these; `hidden` rows show nothing."""
    costs = np.random.default_rng(4).integers(*among, (*true.shape, 100))
    np.put_along_axis(costs, true[..., None], cost, axis=-1)
    costs[hidden] = 127
    tried = everything(true.shape, 100)
    decoded = np.full(true.shape, UNKNOWN) if decoded is None else decoded
    return match_semi_globally(packed(costs.astype(np.uint8), tried), tried, decoded.astype(np.int32))


def test_a_slope_is_followed_through_pixels_that_show_nothing():
    row, column = np.mgrid[:40, :60]
    true = (column / 4 + row / 8 + 3).astype(int)
    found = match(true, 20, (90, 160), None, hidden=slice(15, 19))
    assert abs(found.index - true).max() < 2.5 and abs(found.index - true).mean() < 0.6
    assert np.median(found.margin[15:19]) < np.median(found.margin[:10])


def test_a_steep_surface_is_followed_where_it_was_decoded():
    """Three steps a pixel: every change would be one of the costly kind, and the pixel's own evidence is weak."""
    true = np.tile(3 * np.arange(30) + 5, (25, 1))
    with_slope, without = (match(true, 75, (60, 180), decoded) for decoded in (true + 7, None))  # the place is off
    assert (abs(with_slope.index - true) < 1.5).mean() > 0.97 > 0.75 > (abs(without.index - true) < 1.5).mean()
