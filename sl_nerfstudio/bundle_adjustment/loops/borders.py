"""How far each pixel of a coordinate image is from the border of what was decoded, in compiled loops."""

import numpy as np

from sl_nerfstudio.compiled import compiled_range

FARTHEST = 255


@compiled_range
def border_distances(first, last, values, offsets, widths, heights, out):
    """Steps (also diagonal ones) to the nearest pixel of some frames without a coordinate or outside, up to `FARTHEST`.

    Two passes over each image (Rosenfeld and Pfaltz, Pattern Recognition, 1968).
    """
    for f in range(first, last):
        w, h, start = widths[f], heights[f], offsets[f]
        for y in range(h):
            for x in range(w):
                pixel = start + y * w + x
                out[pixel] = 0
                if not np.isfinite(values[pixel, 0]):
                    continue
                least = 0
                if 0 < x < w - 1 and y > 0:
                    above = pixel - w
                    least = min(out[above - 1], out[above], out[above + 1], out[pixel - 1])
                out[pixel] = min(least + 1, FARTHEST)
        for y in range(h - 1, -1, -1):
            for x in range(w - 1, -1, -1):
                pixel = start + y * w + x
                if out[pixel] == 0:
                    continue
                least = 0
                if 0 < x < w - 1 and y < h - 1:
                    below = pixel + w
                    least = min(out[below - 1], out[below], out[below + 1], out[pixel + 1])
                out[pixel] = min(out[pixel], least + 1)
