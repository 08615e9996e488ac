"""The inverse distance of every pixel that costs least together with changes to its neighbours.

Semi-global matching: Hirschmueller, "Stereo processing by semiglobal matching and mutual information", PAMI 2008. Costs
are added up along eight ways to each pixel; changes of distance cost a little to the next one and more to any other.
Changes are counted from the slope of the surface that was decoded, where one was: otherwise steep surfaces would cost
more than those that face the camera (Scharstein, Taniai and Sinha, "Semi-global stereo matching with surface
orientation priors", 3DV 2017).
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float32, Int32, UInt8
from numpy import ndarray

from sl_nerfstudio.compiled import compiled
from sl_nerfstudio.matching.settings import SmoothnessSettings

UNKNOWN = -(2**20)  # far from the number of any inverse distance
_NEVER = np.int16(16000)  # more than any way costs


@dataclass(frozen=True)
class Matches:
    """The best of the inverse distances that were tried, for every pixel."""

    index: Float32[ndarray, "h w"]  # its number, with the fraction of a step that a parabola through the sums says
    cost: UInt8[ndarray, "h w"]  # its own, without changes
    margin: Float32[ndarray, "h w"]  # by how much the sums of the best rival are larger

    def part(self, rows: slice) -> "Matches":
        """Some rows."""
        return Matches(self.index[rows], self.cost[rows], self.margin[rows])

    @staticmethod
    def joined(parts: Sequence["Matches"]) -> "Matches":
        """One below the other."""
        return Matches(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Matches)))


def match_semi_globally(
    costs: UInt8[ndarray, "h w k"], decoded: Int32[ndarray, "h w"], settings: SmoothnessSettings
) -> Matches:
    """The best match of every pixel. There must be at least three inverse distances.

    `decoded` are the numbers of those that were decoded, `UNKNOWN` where nothing was.
    """
    sums = np.zeros(costs.shape, dtype=np.uint16)
    for step in (1, -1):
        _add_ways(costs, decoded, step, settings.small, settings.large, settings.steepest, sums)
    h, w = costs.shape[:2]
    index, cost = np.empty((h, w), dtype=np.float32), np.empty((h, w), dtype=np.uint8)
    margin = np.empty((h, w), dtype=np.float32)
    _choose(costs, sums, settings.apart, index, cost, margin)
    return Matches(index, cost, margin)


@compiled
def _add_ways(
    costs: ndarray, decoded: ndarray, step: int, small: int, large: int, steepest: int, sums: ndarray
) -> None:
    """Add to `sums` what the least costly way to each pixel costs, less what all its ways share, for four directions.

    With a step of 1, they come from the left and from the three pixels above; with -1 from the opposite ones.
    """
    h, w, count = costs.shape
    beyond = steepest + 1  # places on both sides of a way for inverse distances that are not tried
    shape = (3, w, count + 2 * beyond)
    before, here = np.full(shape, _NEVER, dtype=np.int16), np.full(shape, _NEVER, dtype=np.int16)
    least_before, least_here = np.zeros((3, w), dtype=np.int16), np.zeros((3, w), dtype=np.int16)
    side, least_side = np.full((2, shape[2]), _NEVER, dtype=np.int16), np.int16(0)
    away, near = np.int16(large), np.int16(small)
    for i in range(h):
        row = i if step > 0 else h - 1 - i
        for j in range(w):
            column = j if step > 0 else w - 1 - j
            own, out = costs[row, column], side[j % 2]
            if j == 0:
                least_side = _begin(own, beyond, out)
            else:
                slope = _slope(decoded, row, column, row, column - step, steepest)
                least_side = _go_on(own, side[(j + 1) % 2], least_side, beyond - slope, beyond, near, away, out)
            for n in range(3):
                last, out = column + n - 1, here[n, column]
                if i == 0 or last < 0 or last >= w:
                    least_here[n, column] = _begin(own, beyond, out)
                else:
                    slope = _slope(decoded, row, column, row - step, last, steepest)
                    came, least = before[n, last], least_before[n, last]
                    least_here[n, column] = _go_on(own, came, least, beyond - slope, beyond, near, away, out)
            _add(side[j % 2], here[:, column], beyond, sums[row, column])
        before, here, least_before, least_here = here, before, least_here, least_before


@compiled
def _slope(decoded: ndarray, row: int, column: int, row_before: int, column_before: int, steepest: int) -> int:
    """Steps of the inverse distance from the pixel before to this one; 0 where there is a jump or nothing decoded."""
    steps = decoded[row, column] - decoded[row_before, column_before]
    return steps if abs(steps) <= steepest else 0


@compiled
def _begin(costs: ndarray, beyond: int, out: ndarray) -> np.int16:
    """The first pixel of a way; returns the least of `out`."""
    least = _NEVER
    for k in range(len(costs)):
        out[beyond + k] = costs[k]
        least = min(least, np.int16(costs[k]))
    return least


@compiled
def _go_on(
    costs: ndarray,
    came: ndarray,
    least: np.int16,
    first: int,
    beyond: int,
    near: np.int16,
    away: np.int16,
    out: ndarray,
) -> np.int16:
    """From one pixel to the next, in 16 bits throughout; returns the least of `out`.

    The first inverse distance continues place `first` of the pixel before, the others the places after it.
    """
    count = len(costs)
    below, same, above = came[first - 1 :], came[first:], came[first + 1 :]
    ways, jump, smallest = out[beyond : beyond + count], np.int16(least + away), _NEVER
    for k in range(count):
        cheapest = min(min(np.int16(min(below[k], above[k]) + near), same[k]), jump)
        way = np.int16(np.int16(cheapest - least) + np.int16(costs[k]))
        ways[k] = way
        smallest = min(smallest, way)
    return smallest


@compiled
def _add(side: ndarray, others: ndarray, beyond: int, sums: ndarray) -> None:
    count = len(sums)
    a, b, c, d = side[beyond:], others[0, beyond:], others[1, beyond:], others[2, beyond:]
    for k in range(count):
        sums[k] += np.uint16(a[k] + b[k] + c[k] + d[k])


@compiled
def _choose(costs: ndarray, sums: ndarray, apart: int, index: ndarray, cost: ndarray, margin: ndarray) -> None:
    h, w, count = sums.shape
    for row in range(h):
        for column in range(w):
            total = sums[row, column]
            best = 0
            for k in range(1, count):
                if total[k] < total[best]:
                    best = k
            rival = 65535
            for k in range(count):
                if abs(k - best) > apart and total[k] < rival:
                    rival = total[k]
            cost[row, column], margin[row, column] = costs[row, column, best], rival - np.int64(total[best])
            middle = min(max(best, 1), count - 2)
            a, b, c = np.int64(total[middle - 1]), np.int64(total[middle]), np.int64(total[middle + 1])
            bend = a - 2 * b + c
            index[row, column] = middle + (min(max((a - c) / (2 * bend), -1), 1) if bend > 0 else best - middle)
