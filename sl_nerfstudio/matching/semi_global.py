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
_WAYS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))  # steps (row, column)


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
    for down, right in _WAYS:
        _add_way(costs, decoded, down, right, settings.small, settings.large, settings.steepest, sums)
    h, w = costs.shape[:2]
    index, cost = np.empty((h, w), dtype=np.float32), np.empty((h, w), dtype=np.uint8)
    margin = np.empty((h, w), dtype=np.float32)
    _choose(costs, sums, settings.apart, index, cost, margin)
    return Matches(index, cost, margin)


@compiled
def _add_way(
    costs: ndarray, decoded: ndarray, down: int, right: int, small: int, large: int, steepest: int, sums: ndarray
) -> None:
    """Add to `sums` what the least costly way in one direction to each pixel costs, less what all its ways share."""
    h, w, count = costs.shape
    # Of the row before and of this one, by column; beside the first and the last step there is nothing to go to.
    before, here = np.zeros((w, count + 2), dtype=np.int16), np.zeros((w, count + 2), dtype=np.int16)
    far = np.int16(16000)
    before[:, 0], before[:, count + 1], here[:, 0], here[:, count + 1] = far, far, far, far
    near, away = np.int16(small), np.int16(large)
    for i in range(h):
        row = i if down >= 0 else h - 1 - i
        for j in range(w):
            column = j if right >= 0 else w - 1 - j
            last = column - right
            way = here[column]
            if (down != 0 and i == 0) or last < 0 or last >= w:
                for k in range(count):
                    way[k + 1] = costs[row, column, k]
            else:
                came = here[last] if down == 0 else before[last]
                least = came[1]
                for k in range(2, count + 1):
                    least = min(least, came[k])
                jump = np.int16(least + away)
                slope = decoded[row, column] - decoded[row - down, last]
                slope = slope if abs(slope) <= steepest else 0
                first, end = max(1, 1 + slope), min(count, count + slope) + 1
                for k in range(1, first):
                    way[k] = np.int16(away + np.int16(costs[row, column, k - 1]))
                for k in range(first, end):
                    beside = np.int16(min(came[k - slope - 1], came[k - slope + 1]) + near)
                    cheapest = min(min(came[k - slope], beside), jump)
                    way[k] = np.int16(cheapest - least + np.int16(costs[row, column, k - 1]))
                for k in range(end, count + 1):
                    way[k] = np.int16(away + np.int16(costs[row, column, k - 1]))
            for k in range(count):
                sums[row, column, k] += np.uint16(way[k + 1])
        before, here = here, before


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
