"""Ranges of inverse distances in tiles, and values of what is tried as one array."""

import numpy as np

from sl_nerfstudio.matching.ranges import FEWEST, TILE, TriedRanges


def tiles_of(shape):
    return -(-shape[0] // TILE), -(-shape[1] // TILE)


def everything(shape, count):
    tiles = tiles_of(shape)
    return TriedRanges(np.zeros(tiles, np.int32), np.full(tiles, count, np.int32))


def random_ranges(rng, shape, count):
    """In every fifth tile or so nothing is tried."""
    tiles = tiles_of(shape)
    some = np.where(rng.random(tiles) < 0.2, 0, rng.integers(FEWEST, count + 1, tiles))
    return TriedRanges(rng.integers(0, count - some + 1).astype(np.int32), some.astype(np.int32))


def is_tried(tried, shape, count):
    first, some = (
        np.kron(x, np.ones((TILE, TILE), int))[: shape[0], : shape[1], None] for x in (tried.first, tried.count)
    )
    return (np.arange(count) >= first) & (np.arange(count) < first + some)


def packed(values, tried):
    """The values of what is tried, as the matching expects them."""
    out = np.zeros(tried.cells, values.dtype)
    for (a, b), start in np.ndenumerate(tried.start):
        n, first = tried.count[a, b], tried.first[a, b]
        tile = out[start : start + TILE * TILE * n].reshape(TILE, TILE, n)
        some = values[a * TILE : (a + 1) * TILE, b * TILE : (b + 1) * TILE, first : first + n]
        tile[: some.shape[0], : some.shape[1]] = some
    return out


def unpacked(cells, tried, shape, count, missing):
    """The inverse of it; `missing` where nothing is tried."""
    out = np.full((*shape, count), missing, cells.dtype)
    for (a, b), start in np.ndenumerate(tried.start):
        n, first = tried.count[a, b], tried.first[a, b]
        some = out[a * TILE : (a + 1) * TILE, b * TILE : (b + 1) * TILE, first : first + n]
        some[:] = cells[start : start + TILE * TILE * n].reshape(TILE, TILE, n)[: some.shape[0], : some.shape[1]]
    return out
