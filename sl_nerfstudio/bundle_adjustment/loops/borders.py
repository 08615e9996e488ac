"""How far pixels are from the border of what was decoded, in compiled loops."""

import numpy as np

from sl_nerfstudio.bundle_adjustment.loops.pixel_index import is_known, words_of
from sl_nerfstudio.compiled import compiled, compiled_range

FARTHEST = 255


@compiled_range
def border_distances(first, last, index, starts, entries, pixel, found):
    """Steps (also diagonal ones) to the nearest pixel without a coordinate or outside, up to `FARTHEST`.

    `entries[starts[f] : starts[f + 1]]` are the positions in frame f, at `pixel` of it, or outside where that is
    negative.
    """
    words, first_words, widths, heights = index
    for f in range(first, last):
        if starts[f] == starts[f + 1]:
            continue
        steps = np.zeros(widths[f] * heights[f], dtype=np.uint8)
        _steps(words, first_words[f], widths[f], heights[f], steps)
        for k in entries[starts[f] : starts[f + 1]]:
            found[k] = steps[pixel[k]] if pixel[k] >= 0 else 0


@compiled
def _steps(words, first_word, w, h, out):
    """Of one frame, by two passes over it (Rosenfeld and Pfaltz, Pattern Recognition, 1968)."""
    for y in range(h):
        row_word = first_word + y * words_of(w)
        for x in range(w):
            pixel = y * w + x
            if not is_known(words, row_word, x):
                continue
            least = 0
            if 0 < x < w - 1 and y > 0:
                above = pixel - w
                least = min(out[above - 1], out[above], out[above + 1], out[pixel - 1])
            out[pixel] = min(least + 1, FARTHEST)
    for y in range(h - 1, -1, -1):
        for x in range(w - 1, -1, -1):
            pixel = y * w + x
            if out[pixel] == 0:
                continue
            least = 0
            if 0 < x < w - 1 and y < h - 1:
                below = pixel + w
                least = min(out[below - 1], out[below], out[below + 1], out[pixel + 1])
            out[pixel] = min(out[pixel], least + 1)
