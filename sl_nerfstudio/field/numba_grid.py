"""The feature grid in numba: encode points, scatter gradients; and over marked rows, clear a gradient, and Adam."""

from typing import NamedTuple

import numpy as np
from numpy import ndarray

from sl_nerfstudio.field.hash_grid import FEATURES, PRIMES
from sl_nerfstudio.field.simd import gather, gather_jacobian, kernel, part, prefetch, scatter, scatter_pair

# A chunk of points is encoded into `e` [POINTS, depth]: columns 0..2 the point, 3 the constant 1 (it carries the
# first layer's bias), 4..7 zero, then the levels; `depth` is padded to a multiple of 16. The Jacobian `jac` [POINTS,
# 3, depth] holds the derivatives of the level columns with respect to the three coordinates.

POINTS = 128
"""Points per chunk: its activations stay in the core's own cache."""
FIRST = 8
"""Column of the first level."""
_POINTS_AHEAD = 8  # points: rows are prefetched this far ahead
_Y, _Z = np.int64(PRIMES[1]), np.int64(PRIMES[2])
_ONE, _ZERO, _HALF = np.float32(1), np.float32(0), np.float32(0.5)


class GridArrays(NamedTuple):
    """A feature grid as the kernels see it."""

    table: ndarray  # float32 [rows * 8], flat
    weights: ndarray  # float32 [levels]; levels of weight 0 are skipped
    resolutions: ndarray  # int64 [levels]
    offsets: ndarray  # int64 [levels]: first row
    sizes: ndarray  # int64 [levels]: rows
    hashed: ndarray  # bool [levels]


@part
def clamped(x):
    """`x` in [-1, 1]; NaN becomes -1, so that nothing is read outside the table."""
    x = x if x > -_ONE else -_ONE
    return x if x < _ONE else _ONE


@part
def inside(x):
    """Derivative of `clamped`: 1 where it is the identity, else 0."""
    return _ONE if -_ONE <= x <= _ONE else _ZERO


@part
def along(x, resolution):
    """Cell and fraction of a coordinate in [-1, 1]."""
    u = (x + _ONE) * (_HALF * np.float32(resolution))
    cell = np.int64(u)
    cell = cell if cell < resolution else resolution - 1
    return cell, u - np.float32(cell)


@part
def positions(x, y, z, resolution, offset, size, hashed):
    """Positions in the flat table of the eight corners of a cell; x varies fastest."""
    if hashed:
        mask = size - 1
        y0, y1, z0, z1 = y * _Y, (y + 1) * _Y, z * _Z, (z + 1) * _Z
        a, b, c, d = y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1
        w = x + 1
        return (
            ((x ^ a) & mask) + offset << 3,
            ((w ^ a) & mask) + offset << 3,
            ((x ^ b) & mask) + offset << 3,
            ((w ^ b) & mask) + offset << 3,
            ((x ^ c) & mask) + offset << 3,
            ((w ^ c) & mask) + offset << 3,
            ((x ^ d) & mask) + offset << 3,
            ((w ^ d) & mask) + offset << 3,
        )
    side = resolution + 1
    a = x + side * (y + side * z) + offset
    b, c = a + side, a + side * side
    d = c + side
    return a << 3, a + 1 << 3, b << 3, b + 1 << 3, c << 3, c + 1 << 3, d << 3, d + 1 << 3


@part
def locate(px, py, pz, level):
    """Corners and fractions of a point in [-1, 1]^3 on a level (see `level_of`)."""
    resolution, offset, size, hashed = level
    x, tx = along(px, resolution)
    y, ty = along(py, resolution)
    z, tz = along(pz, resolution)
    return positions(x, y, z, resolution, offset, size, hashed), tx, ty, tz


@part
def level_of(grid, level):
    """The description of a level that `locate` needs."""
    return grid.resolutions[level], grid.offsets[level], grid.sizes[level], grid.hashed[level]


@part
def encode_level(grid, level, count, e, depth):
    """Write one level's columns of `e`."""
    place, weight = level_of(grid, level), grid.weights[level]
    column = FIRST + FEATURES * level
    for i in range(count):
        row = i * depth
        if i + _POINTS_AHEAD < count:
            ahead = row + _POINTS_AHEAD * depth
            prefetch(grid.table, locate(e[ahead], e[ahead + 1], e[ahead + 2], place)[0])
        corners, tx, ty, tz = locate(e[row], e[row + 1], e[row + 2], place)
        gather(grid.table, corners, (tx, ty, tz), weight, e, row + column)


@part
def encode_level_jacobian(grid, level, count, e, depth, jac, p, start):
    """Write one level's columns of `e` and `jac`."""
    place, weight = level_of(grid, level), grid.weights[level]
    column = FIRST + FEATURES * level
    slope = weight * _HALF * np.float32(grid.resolutions[level])
    for i in range(count):
        row = i * depth
        if i + _POINTS_AHEAD < count:
            ahead = row + _POINTS_AHEAD * depth
            prefetch(grid.table, locate(e[ahead], e[ahead + 1], e[ahead + 2], place)[0])
        corners, tx, ty, tz = locate(e[row], e[row + 1], e[row + 2], place)
        dx = slope * inside(p[start + i, 0])
        dy = slope * inside(p[start + i, 1])
        dz = slope * inside(p[start + i, 2])
        at = 3 * row + column
        gather_jacobian(grid.table, corners, (tx, ty, tz), weight, e, row + column, (dx, dy, dz), jac, at, depth)


@part
def encode(grid, p, start, count, e, depth, used, jac, want_jacobian):
    """Encode points `start .. start + count` of `p` [n, 3] into `e`, and their derivatives into `jac`.

    Columns from `used` (see `Network`) up to the next multiple of 16 are zero, later ones are left unchanged.
    """
    end = min((used + 15) // 16 * 16, depth)
    for i in range(count):
        row = i * depth
        for a in range(3):
            e[row + a] = clamped(p[start + i, a])
        e[row + 3] = _ONE
        for j in range(4, FIRST):
            e[row + j] = _ZERO
        for j in range(used, end):
            e[row + j] = _ZERO
    for level in range((used - FIRST) // FEATURES):
        if grid.weights[level] == _ZERO:
            column = FIRST + FEATURES * level
            for i in range(count):
                for j in range(column, column + FEATURES):
                    e[i * depth + j] = _ZERO
                    for a in range(3):
                        jac[(3 * i + a) * depth + j] = _ZERO
        elif want_jacobian:
            encode_level_jacobian(grid, level, count, e, depth, jac, p, start)
        else:
            encode_level(grid, level, count, e, depth)


@part
def corner_weights(tx, ty, tz, scale):
    """Trilinear weights, times `scale`, of the eight corners; x varies fastest."""
    ux, uy, uz = _ONE - tx, _ONE - ty, _ONE - tz
    ux, tx = ux * scale, tx * scale
    a, b, c, d = uy * uz, ty * uz, uy * tz, ty * tz
    return ux * a, tx * a, ux * b, tx * b, ux * c, tx * c, ux * d, tx * d


@part
def corner_slopes(tx, ty, tz, vx, vy, vz):
    """Derivatives of the trilinear weights in the direction `v` (of the fractions)."""
    ux, uy, uz = _ONE - tx, _ONE - ty, _ONE - tz
    a, b, c, d = uy * uz, ty * uz, uy * tz, ty * tz
    va, vb = -vy * uz - uy * vz, vy * uz - ty * vz
    vc, vd = -vy * tz + uy * vz, vy * tz + ty * vz
    return (
        ux * va - vx * a,
        tx * va + vx * a,
        ux * vb - vx * b,
        tx * vb + vx * b,
        ux * vc - vx * c,
        tx * vc + vx * c,
        ux * vd - vx * d,
        tx * vd + vx * d,
    )


@kernel
def scatter_level(grid, level, p, start, count, values, gradient, marks, v, slopes, with_slopes):
    """Add one level's gradients to the table's, and mark the rows.

    Point i adds `weight * corner_weights * values[level, i]`, and, `with_slopes`, also the directional derivative of
    the corner weights along `v` [n, 3] times `slopes[level, i]`; values and slopes are [levels, n, 8].
    """
    weight = grid.weights[level]
    if weight == _ZERO:
        return
    place = level_of(grid, level)
    slope = weight * _HALF * np.float32(grid.resolutions[level])
    flat, flat_slopes = values[level].reshape(-1), slopes[level].reshape(-1)
    for i in range(count):
        if i + _POINTS_AHEAD < count:
            ahead = start + i + _POINTS_AHEAD
            px, py, pz = p[ahead, 0], p[ahead, 1], p[ahead, 2]
            prefetch(gradient, locate(clamped(px), clamped(py), clamped(pz), place)[0])
        px, py, pz = p[start + i, 0], p[start + i, 1], p[start + i, 2]
        corners, tx, ty, tz = locate(clamped(px), clamped(py), clamped(pz), place)
        weights = corner_weights(tx, ty, tz, weight)
        if with_slopes:
            vx = v[start + i, 0] * inside(px) * slope
            vy = v[start + i, 1] * inside(py) * slope
            vz = v[start + i, 2] * inside(pz) * slope
            changes = corner_slopes(tx, ty, tz, vx, vy, vz)
            scatter_pair(gradient, corners, FEATURES * i, weights, flat, changes, flat_slopes)
        else:
            scatter(gradient, corners, FEATURES * i, weights, flat)
        for corner in corners:
            marks[corner // FEATURES] = 1


# A batch of points marks a small part of the rows, scattered throughout the table. Most of the time is spent waiting
# for memory, so the marked rows are listed first and prefetched before they are used.

LIST = 1024
"""Rows listed at a time."""
_ROWS_AHEAD = 12


@part
def list_marked(marks, start, stop, rows):
    """List and clear marks, from `start` on, until `rows` is full; returns the number of rows and where to continue."""
    words, n, row = marks.view(np.int64), 0, start
    while row < stop and n <= len(rows) - 8:
        if words[row // 8] != 0:
            for i in range(row, min(row + 8, stop)):
                if marks[i]:
                    marks[i] = 0
                    rows[n] = i
                    n += 1
        row += 8
    return n, row


@kernel
def clear(gradient, marks, start, stop, rows):
    """Zero the marked rows in `start .. stop` of a flat gradient, and their marks; `start` is a multiple of 8."""
    while start < stop:
        n, start = list_marked(marks, start, stop, rows)
        for k in range(n):
            if k + _ROWS_AHEAD < n:
                prefetch(gradient, (rows[k + _ROWS_AHEAD] * FEATURES,))
            for i in range(FEATURES):
                gradient[rows[k] * FEATURES + i] = _ZERO


@kernel
def adam(table, gradient, moments, steps, marks, start, stop, rows, corrections, lr, beta1, beta2, eps):
    """One step of Adam for every marked row whose gradient is not exactly zero; clears the gradient and the marks.

    `moments` [row, 2, 8], flat: mean and mean square of the gradient. `steps` counts the steps of each row, and
    `corrections[t]` holds the factors of step t's mean and of the root of its mean square.
    """
    last = len(corrections) - 1
    while start < stop:
        n, start = list_marked(marks, start, stop, rows)
        for k in range(n):
            if k + _ROWS_AHEAD < n:
                at = rows[k + _ROWS_AHEAD] * FEATURES
                prefetch(gradient, (at,))
                prefetch(table, (at,))
                prefetch(moments, (2 * at,))
            row = rows[k]
            at = row * FEATURES
            seen = False
            for i in range(at, at + FEATURES):
                seen |= gradient[i] != _ZERO
            if not seen:
                continue
            t = min(np.int64(steps[row]) + 1, last)
            steps[row] = t
            rate, root = lr * corrections[t, 0], corrections[t, 1]
            for i in range(FEATURES):
                g = gradient[at + i]
                m = beta1 * moments[2 * at + i] + (_ONE - beta1) * g
                s = beta2 * moments[2 * at + FEATURES + i] + (_ONE - beta2) * g * g
                moments[2 * at + i], moments[2 * at + FEATURES + i] = m, s
                table[at + i] -= rate * m / (np.sqrt(s) * root + eps)
                gradient[at + i] = _ZERO
