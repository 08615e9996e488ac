"""Phase unwrapping: from nodes whose place is known to coordinates of all pixels.

The coordinate of a pixel is a whole number plus its phase. The whole number spreads from the nodes over neighbouring
pixels as long as the phase changes smoothly.
"""

import numpy as np
from jaxtyping import Bool, Float32, Int32
from numpy import ndarray

from sl_nerfstudio.compiled import compiled

_LARGEST_STEP = 0.3  # periods between two neighbouring pixels
_FARTHEST = 2.0  # periods from the node


def spread(
    phase: Float32[ndarray, "h w 2"],
    seen: Bool[ndarray, "h w"],
    pixel: Int32[ndarray, "n 2"],
    place: Int32[ndarray, "n 2"],
) -> Float32[ndarray, "h w 2"]:
    """Coordinates (x, y) in periods; NaN where no node reaches.

    `phase` is from -0.5 to 0.5 periods; `pixel` (row, column) shows the node at `place` (row, column) of the pattern.
    """
    coords = np.full(phase.shape, np.nan, dtype=np.float32)
    _spread(phase, seen, pixel, place, coords, np.float32(_LARGEST_STEP), np.float32(_FARTHEST))
    return coords


@compiled
def _spread(
    phase: ndarray,
    seen: ndarray,
    pixel: ndarray,
    place: ndarray,
    coords: ndarray,
    largest_step: float,
    farthest: float,
) -> None:
    """Breadth first: every pixel is reached from the nearest node, counted in pixels."""
    h, w = seen.shape
    queue = np.empty((h * w, 3), dtype=np.int32)
    end = 0
    for k in range(len(pixel)):
        r, c = pixel[k, 0], pixel[k, 1]
        if 0 <= r < h and 0 <= c < w and seen[r, c] and np.isnan(coords[r, c, 0]):
            coords[r, c, 0] = place[k, 1] + phase[r, c, 0]
            coords[r, c, 1] = place[k, 0] + phase[r, c, 1]
            queue[end, 0], queue[end, 1], queue[end, 2] = r, c, k
            end += 1
    start = 0
    while start < end:
        r, c, k = queue[start, 0], queue[start, 1], queue[start, 2]
        start += 1
        for d in range(4):
            rr = r + (d == 1) - (d == 3)
            cc = c + (d == 0) - (d == 2)
            if rr < 0 or cc < 0 or rr >= h or cc >= w or not seen[rr, cc] or not np.isnan(coords[rr, cc, 0]):
                continue
            dx = phase[rr, cc, 0] - phase[r, c, 0]
            dy = phase[rr, cc, 1] - phase[r, c, 1]
            dx -= np.rint(dx)
            dy -= np.rint(dy)
            x, y = coords[r, c, 0] + dx, coords[r, c, 1] + dy
            if max(abs(dx), abs(dy)) > largest_step or max(abs(x - place[k, 1]), abs(y - place[k, 0])) > farthest:
                continue
            coords[rr, cc, 0], coords[rr, cc, 1] = x, y
            queue[end, 0], queue[end, 1], queue[end, 2] = rr, cc, k
            end += 1
