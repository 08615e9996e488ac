"""The field on the CPU: numba kernels, ranges of points in parallel."""

from collections.abc import Callable
from functools import partial, reduce
from math import sqrt
from threading import local
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.field.backend import FieldState, Pulled, SeparateBackend, Target
from sl_nerfstudio.field.hash_grid import FEATURES, GridLayout
from sl_nerfstudio.field.numba_grid import FIRST, POINTS, GridArrays, clamped, encode, inside, scatter_level
from sl_nerfstudio.field.simd import contract, kernel, multiply, part
from sl_nerfstudio.parallel import parallel, split, threads

# The MLP in numba, on one chunk of encoded points at a time.
#
# Hidden layers: `z = W a + b`, `a = knee(z)`, a ReLU with a rounded corner (see `activate`).

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
    used: int  # columns of the encoded point up to the last level that is switched on
    knee: np.float32  # half-width of the rounded corner of the activation


class Scratch(NamedTuple):
    """Buffers of one thread for one chunk; [POINTS, width] each; those of the layers are stacked."""

    e: ndarray  # encoded points
    jac: ndarray  # their derivatives with respect to the points
    a: ndarray  # activations of each layer
    t: ndarray  # their position on the activation's corner, 0 .. 1; see `activate`
    u: ndarray  # derivative of f with respect to each layer's pre-activations
    h: ndarray  # the same with respect to each layer's activations
    z_dot: ndarray  # directional derivative of each layer's pre-activations
    a_dot: ndarray  # the same of each layer's activations
    e_dot: ndarray  # the same of the encoded points
    d: ndarray  # adjoint of the current layer's pre-activations
    d2: ndarray  # the same of the layer before it
    de: ndarray  # adjoint of the encoded points
    ue: ndarray  # derivative of f with respect to the encoded points


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


# The whole field in numba: value, gradient, and their pull-backs, for a range of points.
#
# Each kernel encodes a chunk of points, runs the MLP on it and discards everything: recomputing a chunk in the core's
# cache is cheaper than storing and re-reading its activations. Sums over points go into buffers of the range, so that
# ranges can run in parallel and results do not depend on how they were scheduled.
#
# The gradient's pull-back rests on this: for a constant direction v, `v . grad f` is the directional derivative of f,
# so its parameter gradient is one more reverse sweep through the pair (f, directional derivative of f).


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
def evaluate_fused(grid, network, scratch, p, start, stop, f, gradient, want_gradient):
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
def pull_back_fused(grid, network, scratch, p, start, stop, g, weights, levels, offset, want_parameters, dp, want_dp):
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
def pull_back_gradient_fused(grid, network, scratch, p, start, stop, g, v, weights, levels, slopes, offset):
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


# From torch's parameters to the kernels' layout, and gradients back.


def pack_grid(layout: GridLayout, state: FieldState) -> GridArrays:
    """The grid for the kernels; the table is shared, not copied."""
    return GridArrays(
        table=state.table.detach().numpy().reshape(-1),
        weights=state.level_weights.numpy(),
        resolutions=np.array(layout.resolutions, np.int64),
        offsets=np.array(layout.offsets, np.int64),
        sizes=np.array(layout.sizes, np.int64),
        hashed=np.array(layout.hashed, np.bool_),
    )


def pack_network(layout: GridLayout, state: FieldState, knee: float) -> Network:
    """Copies of the MLP's weights, padded to multiples of 16, in both orders."""
    matrices, biases = [w.detach().numpy() for w in state.mlp[0::2]], [b.detach().numpy() for b in state.mlp[1::2]]
    width, layers = matrices[0].shape[0], len(matrices) - 1
    depth, hidden = _padded(FIRST + layout.width), _padded(width)
    first = np.zeros((hidden, depth), np.float32)  # (output, input), as in torch
    first[:width, :3] = matrices[0][:, :3]
    first[:width, 3] = biases[0]
    first[:width, FIRST : FIRST + layout.width] = matrices[0][:, 3:]
    middle = np.zeros((layers - 1, hidden, hidden), np.float32)
    bias = np.zeros((layers - 1, hidden), np.float32)
    for i in range(1, layers):
        middle[i - 1, :width, :width] = matrices[i]
        bias[i - 1, :width] = biases[i]
    last = np.zeros(hidden + 1, np.float32)
    last[:width] = matrices[-1][0]
    last[hidden] = biases[-1][0]
    on = np.flatnonzero(state.level_weights.numpy())
    return Network(
        weights=Weights(first.T.ravel(), middle.swapaxes(1, 2).ravel(), bias.ravel(), last),
        first_transposed=first.ravel(),
        middle_transposed=middle.ravel(),
        depth=depth,
        hidden=hidden,
        layers=layers,
        used=FIRST + FEATURES * (int(on[-1]) + 1 if len(on) else 0),
        knee=np.float32(knee),
    )


def unpack_gradients(
    layout: GridLayout, state: FieldState, network: Network, parts: list[Weights]
) -> tuple[Tensor, ...]:
    """Sum of the MLP's gradients, in the shapes and the order of the parameters."""
    width, depth, hidden = state.mlp[0].shape[0], network.depth, network.hidden
    sums = Weights(*(reduce(np.add, part) for part in zip(*parts, strict=True)))
    first = sums.first.reshape(depth, hidden)[:, :width].T
    middle = sums.middle.reshape(-1, hidden, hidden)[:, :width, :width].swapaxes(1, 2)
    bias = sums.bias.reshape(-1, hidden)[:, :width]
    result = [np.concatenate([first[:, :3], first[:, FIRST : FIRST + layout.width]], 1), first[:, 3]]
    for i in range(network.layers - 1):
        result += [middle[i], bias[i]]
    result += [sums.last[None, :width], sums.last[hidden:]]
    return tuple(torch.from_numpy(np.ascontiguousarray(x)) for x in result)


def _padded(n: int) -> int:
    return -(-n // 16) * 16


_BATCH = 16384  # points whose feature gradients are kept (in cache) between the MLP and the table

_buffers = local()


class NumbaField(SeparateBackend):
    """The field for float32 on the CPU with 8 features per level."""

    def __init__(self, layout: GridLayout, knee: float):
        self.layout = layout
        self.knee = knee

    def evaluate(
        self, state: FieldState, p: Float[Tensor, "n 3"], gradient: bool
    ) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"] | None]:
        """See `SeparateBackend`."""
        grid, network, xyz = self._packed(state, p)
        f = np.empty(len(xyz), np.float32)
        n = np.empty((len(xyz) if gradient else 0, 3), np.float32)

        def work(start: int, stop: int) -> None:
            evaluate_fused(grid, network, _scratch(network), xyz, start, stop, f, n, gradient)

        parallel([partial(work, start, stop) for start, stop in _ranges(len(xyz))])
        return torch.from_numpy(f), torch.from_numpy(n) if gradient else None

    def pull_back(
        self, state: FieldState, p: Float[Tensor, "n 3"], g: Float[Tensor, "n"], points: bool, to: Target
    ) -> Pulled:
        """See `SeparateBackend`; points whose `g` is negligible are left out."""
        heavy = _heavy(g)
        if heavy is not None:
            some = self.pull_back(state, p[heavy], g[heavy], points, to)
            dp = None if some.points is None else torch.zeros_like(p).index_copy_(0, heavy, some.points)
            return Pulled(dp, some.mlp)
        grid, network, xyz = self._packed(state, p)
        upstream = _array(g)
        dp = np.empty((len(xyz) if points else 0, 3), np.float32)

        def work(sums: Weights, levels: np.ndarray, _: np.ndarray, offset: int, start: int, stop: int) -> None:
            outputs = (sums, levels, offset, to.parameters, dp, points)
            pull_back_fused(grid, network, _scratch(network), xyz, start, stop, upstream, *outputs)

        parts = self._sweep(grid, network, xyz, None, to, work)
        mlp = unpack_gradients(self.layout, state, network, parts) if to.parameters else None
        return Pulled(torch.from_numpy(dp) if points else None, mlp)

    def pull_back_gradient(
        self, state: FieldState, p: Float[Tensor, "n 3"], g: Float[Tensor, "n"], v: Float[Tensor, "n 3"], to: Target
    ) -> tuple[Tensor, ...]:
        """See `SeparateBackend`."""
        grid, network, xyz = self._packed(state, p)
        upstream, direction = _array(g), _array(v)

        def work(sums: Weights, levels: np.ndarray, slopes: np.ndarray, offset: int, start: int, stop: int) -> None:
            pull_back_gradient_fused(
                grid, network, _scratch(network), xyz, start, stop, upstream, direction, sums, levels, slopes, offset
            )

        parts = self._sweep(grid, network, xyz, direction, to, work)
        return unpack_gradients(self.layout, state, network, parts)

    def _packed(self, state: FieldState, p: Tensor) -> tuple[GridArrays, Network, np.ndarray]:
        return pack_grid(self.layout, state), pack_network(self.layout, state, self.knee), _array(p)

    def _sweep(
        self,
        grid: GridArrays,
        network: Network,
        xyz: np.ndarray,
        direction: np.ndarray | None,
        to: Target,
        work: Callable[..., None],
    ) -> list[Weights]:
        """For each batch, run the MLP in parallel over ranges of points, then the table in parallel over levels.

        Returns the sums of MLP gradients of the ranges. Results do not depend on timing: each range has its own sums,
        and each level of the table is written by one thread, in the order of the points.
        """
        batch = min(len(xyz), _BATCH)
        ranges = _ranges(batch)
        sums = [Weights(*map(np.zeros_like, network.weights)) for _ in ranges]
        levels = np.empty((self.layout.levels, batch if to.parameters else 0, FEATURES), np.float32)
        slopes = np.empty((self.layout.levels, 0 if direction is None else batch, FEATURES), np.float32)
        v = xyz if direction is None else direction
        on = [level for level in reversed(range(self.layout.levels)) if grid.weights[level]]
        for first in range(0, len(xyz), _BATCH):
            count = min(_BATCH, len(xyz) - first)
            of_ranges = [
                partial(work, part, levels, slopes, first, first + start, first + min(stop, count))
                for (start, stop), part in zip(ranges, sums, strict=True)
            ]
            parallel(of_ranges)
            if to.table is None:
                continue
            gradient = to.table.numpy().reshape(-1)
            touched = np.empty(self.layout.rows, np.uint8) if to.marks is None else to.marks.numpy()
            arrays = (xyz, first, count, levels, gradient, touched, v, slopes, direction is not None)
            parallel([partial(scatter_level, grid, level, *arrays) for level in on])
        return sums


def _heavy(g: Float[Tensor, "n"]) -> Tensor | None:
    """Indices of the points that matter, or None if leaving out the others would not save much.

    All others together change no sum over the points by more than the rounding (2^-24) of its largest term. Because of
    the rendering weights most points of a ray are negligible: those in free space and those deep behind the surface.
    """
    if len(g) == 0:
        return None
    size = g.abs()
    light = size <= size.max() * (2.0**-24 / len(g))  # false for NaN, which must be kept
    if light.all() or light.count_nonzero() < 0.1 * len(g):
        return None
    return light.logical_not_().nonzero()[:, 0]


def _scratch(network: Network) -> Scratch:
    """This thread's buffers."""
    depth, hidden, layers = sizes = (network.depth, network.hidden, network.layers)
    if getattr(_buffers, "sizes", None) != sizes:
        width = {"e": depth, "e_dot": depth, "de": depth, "ue": depth, "jac": 3 * depth, "d": hidden, "d2": hidden}
        arrays = {k: np.zeros(POINTS * width.get(k, layers * hidden), np.float32) for k in Scratch._fields}
        _buffers.sizes, _buffers.scratch = sizes, Scratch(**arrays)
    return _buffers.scratch


def _array(t: Tensor) -> np.ndarray:
    return t.detach().contiguous().numpy()


def _ranges(n: int) -> list[tuple[int, int]]:
    """Twice as many ranges as threads, so that other threads can take over work from a slow one."""
    count = threads()
    return split(n, 1 if count == 1 else 2 * count, POINTS)
