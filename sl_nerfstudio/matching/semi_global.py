"""Semi-global matching: the inverse distances that cost least together with those of the pixels around.

Costs are added up along eight ways to each pixel; changes of distance cost a little to the next one and more to any
other (Hirschmueller, "Stereo processing by semiglobal matching and mutual information", PAMI 2008). Changes are counted
from the slope of the surface that was decoded, where one was: otherwise steep surfaces would cost more than those that
face the camera (Scharstein, Taniai and Sinha, "Semi-global stereo matching with surface orientation priors", 3DV 2017).
What is not tried in a tile costs more than any way.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Int32, UInt8
from numpy import ndarray

from sl_nerfstudio.decoding.decoder import Layer
from sl_nerfstudio.matching.costs import OUTSIDE
from sl_nerfstudio.matching.ranges import TILE, TriedRanges
from sl_nerfstudio.parallel import compiled

SMALL, LARGE = 30, 250  # costs of a change to the next inverse distance, and to any other
STEEPEST = 4  # steps from one pixel to the next up to which a decoded surface is steep; beyond, it has a jump there
APART = 3  # steps from the best inverse distance within which another one is no rival

_NEVER = np.int16(16000)  # more than any way costs


@dataclass(frozen=True)
class StereoMatches:
    """The best of the inverse distances that were tried, for every pixel."""

    index: Layer  # its number, with the fraction of a step that a parabola through the sums says;
    # NaN where none was tried
    cost: UInt8[ndarray, "h w"]  # its own, without changes
    margin: Layer  # of the best rival's sums over its own, at most one change for each way

    def part(self, rows: slice) -> "StereoMatches":
        """The matches of some rows."""
        return StereoMatches(self.index[rows], self.cost[rows], self.margin[rows])

    @staticmethod
    def joined(parts: Sequence["StereoMatches"]) -> "StereoMatches":
        """The matches of parts, one below the other."""
        return StereoMatches(
            *(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(StereoMatches))
        )


def match_semi_globally(
    costs: UInt8[ndarray, "cells"], tried: TriedRanges, decoded: Int32[ndarray, "h w"]
) -> StereoMatches:
    """The best match of every pixel.

    `decoded` are the numbers of the inverse distances that were decoded, `UNKNOWN` where nothing was.
    """
    sums = np.zeros(costs.shape, dtype=np.uint16)
    places = tried.first, tried.count, tried.start
    for step in (1, -1):
        _add_ways(costs, *places, decoded, step, sums)
    index = np.full(decoded.shape, np.nan, dtype=np.float32)
    cost, margin = np.full(decoded.shape, OUTSIDE, dtype=np.uint8), np.zeros(decoded.shape, dtype=np.float32)
    _choose(costs, sums, *places, index, cost, margin)
    return StereoMatches(index, cost, margin)


@compiled
def _add_ways(
    costs: ndarray, first: ndarray, count: ndarray, start: ndarray, decoded: ndarray, step: int, sums: ndarray
) -> None:
    """Add to `sums` what the least costly way to each pixel costs, less what all its ways share, for four directions.

    With a step of 1, they come from the left and from the three pixels above; with -1 from the opposite ones.
    """
    h, w = decoded.shape
    beyond = STEEPEST + 1  # places on both sides of a way for inverse distances that are not tried
    # the ways from the pixels before: none costs less than never beyond the image, and where nothing is tried
    shape = (3, w + 2, (first + count).max() + 2 * beyond)
    before, here = np.full(shape, _NEVER, dtype=np.int16), np.full(shape, _NEVER, dtype=np.int16)
    least_before, least_here = np.full(shape[:2], _NEVER, dtype=np.int16), np.full(shape[:2], _NEVER, dtype=np.int16)
    side = np.full((2, shape[2]), _NEVER, dtype=np.int16)
    away, near = np.int16(LARGE), np.int16(SMALL)
    for i in range(h):
        row = i if step > 0 else h - 1 - i
        if row // TILE != (row - step) // TILE or row // TILE != (row - 2 * step) // TILE:
            here[:], least_here[:] = _NEVER, _NEVER  # other ranges than two rows before
        side[:], least_side = _NEVER, _NEVER
        for j in range(w):
            column = j if step > 0 else w - 1 - j
            if column // TILE != (column - 2 * step) // TILE:
                side[j % 2] = _NEVER
            a, b = row // TILE, column // TILE
            n, low = count[a, b], beyond + first[a, b]
            if n == 0:
                least_side = _NEVER
                continue
            place = start[a, b] + ((row % TILE) * TILE + column % TILE) * n
            own, left = costs[place : place + n], side[j % 2, low : low + n]
            slope = _slope(decoded, row, column, 0, -step)
            least_side = _go_on(own, side[(j + 1) % 2], least_side, low - slope, near, away, left)
            for m in range(3):
                slope = _slope(decoded, row, column, -step, m - 1)
                came, least = before[m, column + m], least_before[m, column + m]
                out = here[m, column + 1, low : low + n]
                least_here[m, column + 1] = _go_on(own, came, least, low - slope, near, away, out)
            _add(left, here[:, column + 1, low : low + n], sums[place : place + n])
        before, here, least_before, least_here = here, before, least_here, least_before


@compiled
def _slope(decoded: ndarray, row: int, column: int, down: int, right: int) -> int:
    """Steps of the inverse distance from the pixel before to this one; 0 where there is a jump or nothing decoded."""
    before, beside = row + down, column + right
    if before < 0 or before >= decoded.shape[0] or beside < 0 or beside >= decoded.shape[1]:
        return 0
    steps = decoded[row, column] - decoded[before, beside]
    return steps if abs(steps) <= STEEPEST else 0


@compiled
def _go_on(
    costs: ndarray, came: ndarray, least: np.int16, first: int, near: np.int16, away: np.int16, out: ndarray
) -> np.int16:
    """Go from one pixel to the next, in 16 bits throughout; returns the least of `out`.

    The first inverse distance continues place `first` of the pixel before, the others the places after it.
    """
    below, same, above = came[first - 1 :], came[first:], came[first + 1 :]
    jump, smallest = np.int16(least + away), _NEVER
    for k in range(len(out)):
        cheapest = min(min(np.int16(min(below[k], above[k]) + near), same[k]), jump)
        way = np.int16(np.int16(cheapest - least) + np.int16(costs[k]))
        out[k] = way
        smallest = min(smallest, way)
    return smallest


@compiled
def _add(side: ndarray, others: ndarray, sums: ndarray) -> None:
    b, c, d = others[0], others[1], others[2]
    for k in range(len(sums)):
        sums[k] += np.uint16(side[k] + b[k] + c[k] + d[k])


@compiled
def _choose(
    costs: ndarray,
    sums: ndarray,
    first: ndarray,
    count: ndarray,
    start: ndarray,
    index: ndarray,
    cost: ndarray,
    margin: ndarray,
) -> None:
    h, w = index.shape
    for row in range(h):
        for column in range(w):
            n = count[row // TILE, column // TILE]
            if n == 0:
                continue
            place = start[row // TILE, column // TILE] + ((row % TILE) * TILE + column % TILE) * n
            total = sums[place : place + n]
            best = 0
            for k in range(1, n):
                if total[k] < total[best]:
                    best = k
            rival = np.int64(total[best]) + 8 * LARGE
            for k in range(n):
                if abs(k - best) > APART:
                    rival = min(rival, np.int64(total[k]))
            cost[row, column], margin[row, column] = costs[place + best], rival - total[best]
            middle = min(max(best, 1), n - 2)
            a, b, c = np.int64(total[middle - 1]), np.int64(total[middle]), np.int64(total[middle + 1])
            bend = a - 2 * b + c
            shift = min(max((a - c) / (2 * bend), -1), 1) if bend > 0 else best - middle
            index[row, column] = first[row // TILE, column // TILE] + middle + shift
