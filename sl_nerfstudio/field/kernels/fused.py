"""The whole field in numba: value, gradient, and their pull-backs, for a range of points.

Each kernel encodes a chunk of points, runs the MLP on it and discards everything: recomputing a chunk in the core's
cache is cheaper than storing and re-reading its activations. Sums over points go into buffers of the range, so that
ranges can run in parallel and results do not depend on how they were scheduled.

The gradient's pull-back rests on this: for a constant direction v, `v . grad f` is the directional derivative of f,
so its parameter gradient is one more reverse sweep through the pair (f, directional derivative of f).
"""

from math import sqrt

import numpy as np

from sl_nerfstudio.field.kernels.grid import FIRST, POINTS, clamped, encode, inside
from sl_nerfstudio.field.kernels.mlp import (
    add_layer,
    derivatives,
    directional,
    forward,
    slope,
    to_input,
    to_layer_before,
)
from sl_nerfstudio.field.kernels.simd import FEATURES, contract, kernel, part

_ONE, _ZERO, _HALF = np.float32(1), np.float32(0), np.float32(0.5)


@part
def distance_to_box(p, i):
    """Distance of point i from [-1, 1]^3; NaN (so not zero) for NaN."""
    square = _ZERO
    for a in range(3):
        step = p[i, a] - clamped(p[i, a])
        square += step * step
    return np.float32(sqrt(square))


@part
def apply_jacobian(network, scratch, count, p, start, out):
    """`out[start + i] = (d e / d p)^T ue` for each point of the chunk."""
    depth, levels = network.depth, (network.used - FIRST) // FEATURES
    for i in range(count):
        row = i * depth
        for a in range(3):
            out[start + i, a] = scratch.ue[row + a] * inside(p[start + i, a])
        if levels > 0:
            x, y, z = contract(scratch.jac, 3 * row + FIRST, depth, scratch.ue, row + FIRST, levels)
            out[start + i, 0] += x
            out[start + i, 1] += y
            out[start + i, 2] += z


@part
def add_outside(p, i, weight, out):
    """Add `weight` times the gradient of the distance to the box."""
    distance = distance_to_box(p, i)
    if distance != _ZERO:  # also true for NaN
        for a in range(3):
            out[i, a] += weight * (p[i, a] - clamped(p[i, a])) / distance


@kernel
def evaluate(grid, network, scratch, p, start, stop, f, gradient, want_gradient):
    """Values `f[start:stop]` and, on request, gradients `gradient[start:stop]` of points `p` [n, 3]."""
    hidden, last = network.hidden, network.weights.last
    top = scratch.a[(network.layers - 1) * POINTS * hidden :]
    for first in range(start, stop, POINTS):
        count = min(POINTS, stop - first)
        rows = (count + 7) // 8 * 8
        encode(grid, p, first, count, scratch.e, network.depth, network.used, scratch.jac, want_gradient)
        forward(network, scratch, rows)
        for i in range(count):
            total = last[hidden]
            for j in range(hidden):
                total += last[j] * top[i * hidden + j]
            f[first + i] = total + distance_to_box(p, first + i)
        if want_gradient:
            derivatives(network, scratch, rows)
            apply_jacobian(network, scratch, count, p, first, gradient)
            for i in range(first, first + count):
                add_outside(p, i, _ONE, gradient)


@part
def spread_levels(network, rows_of, out, first, count):
    """Copy the level columns of a chunk [count, depth] to `out` [levels, n, 8], from point `first` on."""
    depth = network.depth
    for level in range((network.used - FIRST) // FEATURES):
        for i in range(count):
            for j in range(FEATURES):
                out[level, first + i, j] = rows_of[i * depth + FIRST + FEATURES * level + j]


@kernel
def pull_back(grid, network, scratch, p, start, stop, g, weights, levels, offset, want_parameters, dp, want_dp):
    """Pull back `g`, the gradient of a loss with respect to the values.

    With `want_parameters`, adds to the MLP gradients `weights` and writes those of the level features to `levels`
    [levels, n, 8] (point `offset` first). With `want_dp`, writes those of the points to `dp`.
    """
    hidden, size, top = network.hidden, POINTS * network.hidden, network.layers - 1
    last, d_last = network.weights.last, weights.last
    for first in range(start, stop, POINTS):
        count = min(POINTS, stop - first)
        rows = (count + 7) // 8 * 8
        encode(grid, p, first, count, scratch.e, network.depth, network.used, scratch.jac, want_dp)
        forward(network, scratch, rows)
        a, t, d, d2 = scratch.a[top * size :], scratch.t[top * size :], scratch.d, scratch.d2
        for i in range(count):
            gi = g[first + i]
            for j in range(hidden):
                d[i * hidden + j] = gi * last[j] * slope(t[i * hidden + j])
            if want_parameters:
                d_last[hidden] += gi
                for j in range(hidden):
                    d_last[j] += gi * a[i * hidden + j]
        for layer in range(top, 0, -1):
            before, t = scratch.a[(layer - 1) * size :], scratch.t[(layer - 1) * size :]
            if want_parameters:
                add_layer(network, weights, layer, before, d, count, True)
            to_layer_before(network, d, layer, d2, rows)
            d, d2 = d2, d
            for i in range(count * hidden):
                d[i] *= slope(t[i])
        to_input(network, d, scratch.ue, rows)
        if want_parameters:
            add_layer(network, weights, 0, scratch.e, d, count, True)
            spread_levels(network, scratch.ue, levels, first - offset, count)
        if want_dp:
            apply_jacobian(network, scratch, count, p, first, dp)
            for i in range(count):
                add_outside(p, first + i, g[first + i], dp)


@kernel
def pull_back_gradient(grid, network, scratch, p, start, stop, g, v, weights, levels, slopes, offset):
    """Pull back `g` [n] of the values and `v` [n, 3] of the gradients, to all parameters.

    As `pull_back`; `slopes` receives what `scatter_level` multiplies with the corner weights' derivatives.
    """
    hidden, size, top, depth = network.hidden, POINTS * network.hidden, network.layers - 1, network.depth
    last, d_last, curvature = network.weights.last, weights.last, np.float32(3) / network.knee
    for first in range(start, stop, POINTS):
        count = min(POINTS, stop - first)
        rows = (count + 7) // 8 * 8
        encode(grid, p, first, count, scratch.e, depth, network.used, scratch.jac, True)
        forward(network, scratch, rows)
        derivatives(network, scratch, rows)
        for i in range(count):
            for j in range(depth):
                total = _ZERO
                for a in range(3):
                    total += v[first + i, a] * scratch.jac[(3 * i + a) * depth + j]
                scratch.e_dot[i * depth + j] = total
            for j in range(FIRST):
                scratch.e_dot[i * depth + j] = _ZERO
            for a in range(3):
                scratch.e_dot[i * depth + a] = v[first + i, a] * inside(p[first + i, a])
        directional(network, scratch, rows)
        d, d2 = scratch.d, scratch.d2
        a, a_dot = scratch.a[top * size :], scratch.a_dot[top * size :]
        for i in range(count):
            gi = g[first + i]
            d_last[hidden] += gi
            for j in range(hidden):
                d_last[j] += gi * a[i * hidden + j] + a_dot[i * hidden + j]
                d[i * hidden + j] = gi * last[j]  # at this point with respect to the activations
        for layer in range(top, -1, -1):
            t, h, z_dot = scratch.t[layer * size :], scratch.h[layer * size :], scratch.z_dot[layer * size :]
            for i in range(count * hidden):
                d[i] = d[i] * slope(t[i]) + curvature * t[i] * (_ONE - t[i]) * z_dot[i] * h[i]
            u = scratch.u[layer * size :]
            if layer == 0:
                add_layer(network, weights, 0, scratch.e, d, count, True)
                add_layer(network, weights, 0, scratch.e_dot, u, count, False)
            else:
                add_layer(network, weights, layer, scratch.a[(layer - 1) * size :], d, count, True)
                add_layer(network, weights, layer, scratch.a_dot[(layer - 1) * size :], u, count, False)
                to_layer_before(network, d, layer, d2, rows)
                d, d2 = d2, d
        to_input(network, d, scratch.de, rows)
        spread_levels(network, scratch.de, levels, first - offset, count)
        spread_levels(network, scratch.ue, slopes, first - offset, count)
