"""Random decoded pixels, spread over the decoded part of each frame."""

import numpy as np

from sl_nerfstudio.bundle_adjustment.loops.pixel_index import is_known, known_pixels, words_of
from sl_nerfstudio.bundle_adjustment.loops.random_bits import mixed
from sl_nerfstudio.compiled import compiled, compiled_range


@compiled_range
def draw_pixels(first, last, frames, index, seed, pixels, counts):
    """Up to `pixels.shape[1]` pixels of each frame, one of each occupied square of a lattice; `counts` says how many.

    Both the pixel of a square and the squares are chosen by random bits of the pixels' numbers.
    """
    words, first_words, widths, heights = index
    most = pixels.shape[1]
    for k in range(first, last):
        f = frames[k]
        w, h, first_word = widths[f], heights[f], first_words[f]
        decoded = known_pixels(words, first_word, w, h)
        counts[k] = 0
        if decoded == 0 or most == 0:
            continue
        step = max(1, int((decoded / most) ** 0.5))
        across = w // step + 1
        chosen = np.full(across * (h // step + 1), -1)
        smallest = np.zeros(len(chosen), dtype=np.uint64)
        for row in range(h):
            row_word = first_word + row * words_of(w)
            for column in range(w):
                if is_known(words, row_word, column):
                    n, square = row * w + column, row // step * across + column // step
                    bits = mixed(mixed(seed, f), n)
                    if chosen[square] < 0 or bits < smallest[square]:
                        chosen[square], smallest[square] = n, bits
        count = 0
        for square in range(len(chosen)):
            if chosen[square] >= 0:
                chosen[count] = chosen[square]
                smallest[count] = mixed(mixed(seed + 1, f), chosen[square])
                count += 1
        counts[k] = min(most, count)
        _sort_together(smallest, chosen, count)
        for n in range(counts[k]):
            pixels[k, n] = chosen[n]


@compiled
def _sort_together(keys, values, count):
    """Sort the first `count` keys, and values with them (heapsort); numba takes 1.5 s to compile numpy's `argsort`."""
    start, end = count // 2, count
    while end > 1:
        if start > 0:  # make a heap, then take its largest again and again
            start -= 1
        else:
            end -= 1
            keys[end], keys[0] = keys[0], keys[end]
            values[end], values[0] = values[0], values[end]
        parent = start
        while 2 * parent + 1 < end:
            child = 2 * parent + 1
            if child + 1 < end and keys[child] < keys[child + 1]:
                child += 1
            if not keys[parent] < keys[child]:
                break
            keys[parent], keys[child] = keys[child], keys[parent]
            values[parent], values[child] = values[child], values[parent]
            parent = child
