"""Triangles drawn into a square image: which of them is at each pixel, and where in it."""

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from sl_nerfstudio.compiled import compiled

_GUTTER_PX = 2.0  # how far beside a triangle pixels get its colour: texture filters read beyond the edge


def draw_triangles(
    corners: Float[ndarray, "faces 3 2"], size: int
) -> tuple[Int[ndarray, "size size"], Float[ndarray, "size size 3"]]:
    """The triangle at every pixel of a square texture, -1 where there is none, and its barycentric weights there.

    `corners` are in [0, 1], x to the right and y down; pixel centres are at (i + 0.5) / size. Pixels up to two pixels
    beside a triangle belong to it, unless they are inside another one; their weights continue its plane.
    """
    triangle = np.full((size, size), -1, np.int32)
    weights = np.zeros((size, size, 3), np.float32)
    outside = np.full((size, size), np.inf, np.float32)
    _draw(corners * size, triangle, weights, outside)
    return triangle, weights


@compiled
def _draw(corners: ndarray, triangle: ndarray, weights: ndarray, outside: ndarray) -> None:
    """`outside`: how far, in pixels, a pixel is from the triangle it belongs to, measured across its edges."""
    size = len(triangle)
    for k in range(len(corners)):
        (ax, ay), (bx, by), (cx, cy) = corners[k]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0:
            continue
        # a weight of -1 is one height of the triangle beyond an edge
        height_a = abs(area) / max(np.hypot(cx - bx, cy - by), 1e-12)
        height_b = abs(area) / max(np.hypot(ax - cx, ay - cy), 1e-12)
        height_c = abs(area) / max(np.hypot(bx - ax, by - ay), 1e-12)
        first_x = max(int(min(ax, bx, cx) - _GUTTER_PX), 0)
        first_y = max(int(min(ay, by, cy) - _GUTTER_PX), 0)
        last_x = min(int(max(ax, bx, cx) + _GUTTER_PX), size - 1)
        last_y = min(int(max(ay, by, cy) + _GUTTER_PX), size - 1)
        for row in range(first_y, last_y + 1):
            for column in range(first_x, last_x + 1):
                x, y = column + 0.5, row + 0.5
                a = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                b = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                c = 1.0 - a - b
                beside = max(-a * height_a, -b * height_b, -c * height_c, 0.0)
                if beside <= _GUTTER_PX and beside < outside[row, column]:
                    outside[row, column] = beside
                    triangle[row, column] = k
                    weights[row, column] = (a, b, c)
