"""Medians of the residuals that involve each frame."""

import numpy as np

from sl_nerfstudio.compiled import compiled, compiled_range


@compiled_range
def medians_by_frame(first, last, source_first, source_entries, viewer_first, viewer_entries, values, valid, out):
    """Lower median over the valid entries of two groupings of the same values; infinite where there are none."""
    for f in range(first, last):
        most = source_first[f + 1] - source_first[f] + viewer_first[f + 1] - viewer_first[f]
        mine = np.empty(most)
        count = 0
        for starts, entries in ((source_first, source_entries), (viewer_first, viewer_entries)):
            for e in range(starts[f], starts[f + 1]):
                if valid[entries[e]]:
                    mine[count] = values[entries[e]]
                    count += 1
        out[f] = _smallest(mine, count, (count - 1) // 2) if count else np.inf


@compiled
def _smallest(values, count, k):
    """The k-th smallest (from 0) of the first `count` values, which change places (Hoare's selection).

    numpy's `partition` would do the same, but numba takes 7 s to compile it.
    """
    low, high = 0, count - 1
    while low < high:
        pivot, i, j = values[(low + high) // 2], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if k <= j:
            high = j
        elif k >= i:
            low = i
        else:
            break
    return values[k]
