"""Medians of the residuals that involve each frame."""

import numpy as np

from sl_nerfstudio.compiled import compiled_range


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
        out[f] = np.partition(mine[:count], (count - 1) // 2)[(count - 1) // 2] if count else np.inf
