"""How far the coordinate that a vertex predicts is from those that were decoded around its pixel.

Where four decoded neighbours vary no more than the tangent plane of the surface predicts, their bilinear value is
compared. Otherwise (an edge, or undecoded neighbours) the best of nine pixels is used, each compared with the
prediction on the tangent plane. The surface may bend away from that plane by half of the plane's own change, which is
the difference between the two bounds.
"""

import math

import numpy as np

from sl_nerfstudio.compiled import compiled, compiled_range
from sl_nerfstudio.geometry.devices.compiled_view import ray_of, view_of
from sl_nerfstudio.meshing.loops.derivatives import moved

# A device as one row: world to device (a 3 x 4 matrix), where it is, parameters, code, width and height.
WORLD, EYE, PARAMETERS, CODE, WIDTH, HEIGHT = 0, 12, 15, 23, 24, 25


@compiled
def _within(value, limit):
    """The value, or the limit with its sign if it is beyond; NaN stays."""
    return limit if value > limit else -limit if value < -limit else value


@compiled
def _on_tangent_plane(camera, projector, point, normal, u, v):
    """The coordinate that a plane through a vertex predicts for another camera pixel."""
    a, b, c = ray_of(camera[CODE], u, v, camera[PARAMETERS:CODE])
    x = camera[0] * a + camera[4] * b + camera[8] * c
    y = camera[1] * a + camera[5] * b + camera[9] * c
    z = camera[2] * a + camera[6] * b + camera[10] * c
    ox, oy, oz = camera[EYE], camera[EYE + 1], camera[EYE + 2]
    towards = x * normal[0] + y * normal[1] + z * normal[2]
    away = (point[0] - ox) * normal[0] + (point[1] - oy) * normal[1] + (point[2] - oz) * normal[2]
    distance = away / (towards if towards < 0 else -1e-12)
    X, Y, Z = moved(projector, WORLD, ox + distance * x, oy + distance * y, oz + distance * z)
    found = view_of(projector[CODE], X, Y, Z, projector[PARAMETERS:CODE])
    return found[0], found[1]


@compiled
def _at(coords, row, column, k):
    """A component of the decoded coordinate, beyond the image that of its border."""
    return coords[min(max(row, 0), coords.shape[0] - 1), min(max(column, 0), coords.shape[1] - 1), k]


@compiled
def _bilinear(coords, uv, predicted, most_spread):
    """Distance of the decoded coordinate from the predicted one; NaN where neighbours vary too much or are missing."""
    column, row = math.floor(uv[0] - 0.5), math.floor(uv[1] - 0.5)
    x, y = uv[0] - 0.5 - column, uv[1] - 0.5 - row
    length, spread = 0.0, 0.0
    for k in range(2):
        a = _at(coords, row, column, k) - predicted[k]
        b = _at(coords, row, column + 1, k) - predicted[k]
        c = _at(coords, row + 1, column, k) - predicted[k]
        d = _at(coords, row + 1, column + 1, k) - predicted[k]
        value = (1 - y) * ((1 - x) * a + x * b) + y * ((1 - x) * c + x * d)
        length += value * value
        span = max(max(a, b), max(c, d)) - min(min(a, b), min(c, d))
        spread += span * span if value == value else np.nan
    return math.sqrt(length) if math.sqrt(spread) <= most_spread else np.nan


@compiled
def _best_of_nine(coords, uv, predicted, J, slope):
    """Bounds of the distance for the pixel, of nine, that agrees best with the tangent plane; NaN if none is known."""
    column, row = math.floor(uv[0]), math.floor(uv[1])
    least, most = np.nan, np.nan
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            x, y = column + dx + 0.5 - uv[0], row + dy + 0.5 - uv[1]
            a = _at(coords, row + dy, column + dx, 0) - predicted[0] - (J[0] * x + J[1] * y)
            b = _at(coords, row + dy, column + dx, 1) - predicted[1] - (J[2] * x + J[3] * y)
            distance = math.hypot(a, b)
            closest = max(distance - 0.5 * slope * math.hypot(x, y), 0.0)
            if distance == distance:
                most = distance if not most <= distance else most
                least = closest if not least <= closest else least
    return least, most


@compiled_range
def compare_decoded(first, last, points, normals, which, uv, coords, mask, grown, devices, most_px, offsets, outside):
    """Fill `offsets` (n, 2), bounds of the distance that begin as NaN, and `outside` (n, 2): of `grown`, and of `mask`.

    `uv` (n, 2, 2) are the pixels in camera and pattern of the vertices `which` (n,). `devices` (2, 26) are camera and
    projector. Changes of the coordinate by a camera pixel above `most_px` count as `most_px`.
    """
    for i in range(first, last):
        point, normal, predicted = points[which[i]], normals[which[i]], uv[i, 1]
        u, v = uv[i, 0]
        outside[i, 0] = not grown[int(v), int(u)]
        outside[i, 1] = not mask[int(v), int(u)]
        if outside[i, 1]:
            continue
        right = _on_tangent_plane(devices[0], devices[1], point, normal, u + 1, v)
        below = _on_tangent_plane(devices[0], devices[1], point, normal, u, v + 1)
        J = (
            _within(right[0] - predicted[0], most_px),
            _within(below[0] - predicted[0], most_px),
            _within(right[1] - predicted[1], most_px),
            _within(below[1] - predicted[1], most_px),
        )
        slope = math.sqrt(J[0] * J[0] + J[1] * J[1] + J[2] * J[2] + J[3] * J[3])
        offset = _bilinear(coords, uv[i, 0], predicted, 2 * slope + 1)
        if offset == offset:
            offsets[i, 0] = offsets[i, 1] = offset
        else:
            offsets[i, 0], offsets[i, 1] = _best_of_nine(coords, uv[i, 0], predicted, J, slope)
