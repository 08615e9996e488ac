"""Random decoded pixels, spread over the decoded part of each frame."""

import numpy as np

from sl_nerfstudio.bundle_adjustment.loops.random_bits import mixed
from sl_nerfstudio.compiled import compiled_range


@compiled_range
def draw_pixels(first, last, frames, values, offsets, widths, heights, seed, pixels, counts):
    """Up to `pixels.shape[1]` pixels of each frame, one of each occupied square of a lattice; `counts` says how many.

    Both the pixel of a square and the squares are chosen by random bits of the pixels' numbers.
    """
    most = pixels.shape[1]
    for k in range(first, last):
        f = frames[k]
        start, w, h = offsets[f], widths[f], heights[f]
        decoded = 0
        for n in range(start, start + w * h):
            decoded += np.isfinite(values[n, 0])
        counts[k] = 0
        if decoded == 0 or most == 0:
            continue
        step = max(1, int((decoded / most) ** 0.5))
        across = w // step + 1
        chosen = np.full(across * (h // step + 1), -1)
        smallest = np.zeros(len(chosen), dtype=np.uint64)
        for n in range(w * h):
            if np.isfinite(values[start + n, 0]):
                square = n // w // step * across + n % w // step
                bits = mixed(mixed(seed, f), n)
                if chosen[square] < 0 or bits < smallest[square]:
                    chosen[square], smallest[square] = n, bits
        found = chosen[chosen >= 0]
        order = np.empty(len(found), dtype=np.uint64)
        for n in range(len(found)):
            order[n] = mixed(mixed(seed + 1, f), found[n])
        ranked = found[np.argsort(order)]
        counts[k] = min(most, len(ranked))
        for n in range(counts[k]):
            pixels[k, n] = ranked[n]
