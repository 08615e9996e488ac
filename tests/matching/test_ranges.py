"""Which inverse distances are tried where."""

import numpy as np
import pytest

from sl_nerfstudio.matching.lines import UNKNOWN
from sl_nerfstudio.matching.ranges import FEWEST, LEAST_DECODED, MARGIN, TILE, TriedRanges


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
