"""The MLP in numba, on one chunk of encoded points at a time.

Hidden layers: `z = W a + b`, `a = knee(z)`, a ReLU with a rounded corner (see `activate`).
"""

from typing import NamedTuple

import numpy as np
from numpy import ndarray

from sl_nerfstudio.field.kernels.grid import POINTS
from sl_nerfstudio.field.kernels.simd import multiply, part

_ONE, _ZERO, _HALF = np.float32(1), np.float32(0), np.float32(0.5)


class Weights(NamedTuple):
    """The MLP's weights, or their gradients, in the kernels' layout; all flat float32.

    `first` [depth, hidden] (row 3: bias), `middle` [layers - 1, hidden, hidden] (input, output), `bias`
    [layers - 1, hidden], `last` [hidden + 1] (its bias at the end). Widths are padded to multiples of 16.
    """

    first: ndarray
    middle: ndarray
    bias: ndarray
    last: ndarray


class Network(NamedTuple):
    """Weights with their transposes (output, input), and sizes."""

    weights: Weights
    first_transposed: ndarray
    middle_transposed: ndarray
    depth: int
    hidden: int
    layers: int
    used: int
    """Columns of the encoded point up to the last level that is switched on."""
    knee: np.float32
    """Half-width of the rounded corner of the activation."""


class Scratch(NamedTuple):
    """Buffers of one thread for one chunk; [POINTS, width] each; those of the layers are stacked."""

    e: ndarray
    """Encoded points."""
    jac: ndarray
    """Their derivatives with respect to the points."""
    a: ndarray
    """Activations of each layer."""
    t: ndarray
    """Their position on the activation's corner, 0 .. 1; see `activate`."""
    u: ndarray
    """Derivative of f with respect to each layer's pre-activations."""
    h: ndarray
    """The same with respect to each layer's activations."""
    z_dot: ndarray
    """Directional derivative of each layer's pre-activations."""
    a_dot: ndarray
    """The same of each layer's activations."""
    e_dot: ndarray
    """The same of the encoded points."""
    d: ndarray
    """Adjoint of the current layer's pre-activations."""
    d2: ndarray
    """The same of the layer before it."""
    de: ndarray
    """Adjoint of the encoded points."""
    ue: ndarray
    """Derivative of f with respect to the encoded points."""


def make_scratch(depth: int, hidden: int, layers: int) -> Scratch:
    """Buffers for a network of these sizes."""
    width = {"e": depth, "e_dot": depth, "de": depth, "ue": depth, "jac": 3 * depth, "d": hidden, "d2": hidden}
    return Scratch(**{k: np.zeros(POINTS * width.get(k, layers * hidden), np.float32) for k in Scratch._fields})


@part
def slope(t):
    """Derivative of the activation."""
    return t * t * (np.float32(3) - np.float32(2) * t)


@part
def activate(z, at, bias, rows, hidden, knee, with_bias):
    """Replace `z + bias` by `knee(z)`, and store the position on the corner in `at`.

    With `t = clamp((z + w) / 2 w, 0, 1)` the slope is smoothstep, `3 t^2 - 2 t^3`, and `knee(z) = w t^3 (2 - t) +
    max(z - w, 0)`: 0 below -w, z above w, twice continuously differentiable.
    """
    scale = _HALF / knee
    for i in range(rows):
        row = i * hidden
        for j in range(hidden):
            x = z[row + j]
            if with_bias:
                x += bias[j]
            t = x * scale + _HALF
            t = t if t > _ZERO else _ZERO
            t = t if t < _ONE else _ONE
            y = x - knee
            y = y if y > _ZERO else _ZERO
            z[row + j] = knee * t * t * t * (np.float32(2) - t) + y
            at[row + j] = t


@part
def forward(network, scratch, rows):
    """`a` and `t` of all hidden layers, from `e`."""
    w, hidden, size = network.weights, network.hidden, POINTS * network.hidden
    multiply(scratch.e, network.depth, 1, w.first, hidden, scratch.a, hidden, rows, hidden, network.used, False)
    activate(scratch.a, scratch.t, w.bias, rows, hidden, network.knee, False)
    for layer in range(1, network.layers):
        a = scratch.a[layer * size :]
        matrix = w.middle[(layer - 1) * hidden * hidden :]
        multiply(scratch.a[(layer - 1) * size :], hidden, 1, matrix, hidden, a, hidden, rows, hidden, hidden, False)
        activate(a, scratch.t[layer * size :], w.bias[(layer - 1) * hidden :], rows, hidden, network.knee, True)


@part
def to_layer_before(network, d, layer, out, rows):
    """Adjoint of the activations of the layer before `layer`, from that of the pre-activations of `layer`."""
    hidden = network.hidden
    matrix = network.middle_transposed[(layer - 1) * hidden * hidden :]
    multiply(d, hidden, 1, matrix, hidden, out, hidden, rows, hidden, hidden, False)


@part
def to_input(network, d, out, rows):
    """Adjoint of the encoded points, from that of the first layer's pre-activations."""
    depth, hidden = network.depth, network.hidden
    n = (network.used + 15) // 16 * 16
    multiply(d, hidden, 1, network.first_transposed, depth, out, depth, rows, n, hidden, False)


@part
def add_layer(network, gradient, layer, before, d, count, with_bias):
    """Add `before^T d` to the gradient of a layer's weights, and the sum of `d` to that of its bias."""
    hidden = network.hidden
    if layer == 0:
        depth = network.depth
        multiply(before, 1, depth, d, hidden, gradient.first, hidden, network.used, hidden, count, True)
        return
    matrix = gradient.middle[(layer - 1) * hidden * hidden :]
    multiply(before, 1, hidden, d, hidden, matrix, hidden, hidden, hidden, count, True)
    if with_bias:
        bias = gradient.bias[(layer - 1) * hidden :]
        for i in range(count):
            for j in range(hidden):
                bias[j] += d[i * hidden + j]


@part
def derivatives(network, scratch, rows):
    """`h`, `u` of all layers and `ue`: the derivative of f, from `t`."""
    hidden, size, last = network.hidden, POINTS * network.hidden, network.weights.last
    for layer in range(network.layers - 1, -1, -1):
        h, u, t = scratch.h[layer * size :], scratch.u[layer * size :], scratch.t[layer * size :]
        if layer == network.layers - 1:
            for i in range(rows):
                for j in range(hidden):
                    h[i * hidden + j] = last[j]
        else:
            to_layer_before(network, scratch.u[(layer + 1) * size :], layer + 1, h, rows)
        for i in range(rows * hidden):
            u[i] = h[i] * slope(t[i])
    to_input(network, scratch.u, scratch.ue, rows)


@part
def directional(network, scratch, rows):
    """`z_dot` and `a_dot` of all layers, from `e_dot` and `t`."""
    w, hidden, size = network.weights, network.hidden, POINTS * network.hidden
    for layer in range(network.layers):
        z, a, t = scratch.z_dot[layer * size :], scratch.a_dot[layer * size :], scratch.t[layer * size :]
        if layer == 0:
            multiply(scratch.e_dot, network.depth, 1, w.first, hidden, z, hidden, rows, hidden, network.used, False)
        else:
            matrix = w.middle[(layer - 1) * hidden * hidden :]
            before = scratch.a_dot[(layer - 1) * size :]
            multiply(before, hidden, 1, matrix, hidden, z, hidden, rows, hidden, hidden, False)
        for i in range(rows * hidden):
            a[i] = z[i] * slope(t[i])
