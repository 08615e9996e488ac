"""Ranges of inverse distances in tiles, and values of what is tried as one array."""

import numpy as np

from sl_nerfstudio.matching.ranges import FEWEST, TILE, TriedRanges


def everything(shape, count):
    tiles = -(-shape[0] // TILE), -(-shape[1] // TILE)
    return TriedRanges(np.zeros(tiles, np.int32), np.full(tiles, count, np.int32))


def random_ranges(rng, shape, count):
    """In every fifth tile or so nothing is tried."""
    tiles = everything(shape, count).first.shape
    some = np.where(rng.random(tiles) < 0.2, 0, rng.integers(FEWEST, count + 1, tiles))
    return TriedRanges(rng.integers(0, count - some + 1).astype(np.int32), some.astype(np.int32))


def is_tried(tried, shape, count):
    first, some = (
        np.kron(x, np.ones((TILE, TILE), int))[: shape[0], : shape[1], None] for x in (tried.first, tried.count)
    )
    return (np.arange(count) >= first) & (np.arange(count) < first + some)


def _pairs(cells, values, tried):
    """The place in both arrays of what is tried in each tile: one after the other, and (row, column, number)."""
    for (a, b), start in np.ndenumerate(tried.start):
        n, first = tried.count[a, b], tried.first[a, b]
        tile = cells[start : start + TILE * TILE * n].reshape(TILE, TILE, n)
        some = values[a * TILE : (a + 1) * TILE, b * TILE : (b + 1) * TILE, first : first + n]
        yield tile[: some.shape[0], : some.shape[1]], some


def packed(values, tried):
    """The values of what is tried, as the matching expects them."""
    out = np.zeros(tried.cells, values.dtype)
    for tile, some in _pairs(out, values, tried):
        tile[:] = some
    return out


def unpacked(cells, tried, shape, count):
    """The inverse of it; 0 where nothing is tried."""
    out = np.zeros((*shape, count), cells.dtype)
    for tile, some in _pairs(cells, out, tried):
        some[:] = tile
    return out
