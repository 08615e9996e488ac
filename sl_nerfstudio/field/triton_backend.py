# pyright: basic, reportIndexIssue=false, reportOperatorIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
"""The field on a GPU: Triton kernels for the grid and the activations, torch's matrix products between them.

Values of all n points, and gradients of the last k of them, are computed together: few launches, no waits. A point's
derivative along a direction is propagated like a point, so both are rows of the same matrices: n rows of values, then k
of derivatives. Sums over points use atomic additions, so their last digits differ from run to run.

An encoded point is a row of `8 + 8 levels` numbers: the point in columns 5 to 7, then eight features of each level, at
addresses that allow loads of 16 bytes. The perceptron's input is the row from column 5 on.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from sl_nerfstudio.field.backend import FieldState, Pulled, Target
from sl_nerfstudio.field.device_kernels import block, launch
from sl_nerfstudio.field.hash_grid import FEATURES, PRIMES, GridLayout
from sl_nerfstudio.field.triton_vectors import clamped, dot, length, minus, one_minus_exp, store, vector

_OWN = 5  # the point's first column
_POINTS, _ELEMENTS = 64, 2048  # of a program: points or rows of the table; numbers of hidden layers
_Y, _Z = tl.constexpr(PRIMES[1]), tl.constexpr(PRIMES[2])

# The feature grid. `places` [levels, 3] has the resolution of each level, its first row in the table, and the bits that
# its hash keeps (0: not hashed).


@triton.jit
def _axis(x, resolution):
    """Of coordinates: the cell, the weight of its far side, and the weight's derivative."""
    u = (clamped(x) + 1.0) * (0.5 * resolution)
    cell = tl.minimum(u.to(tl.int32), resolution - 1)
    return cell, u - cell.to(tl.float32), tl.where((x >= -1.0) & (x <= 1.0), 0.5 * resolution, 0.0)


@triton.jit
def _cells(places, level, p):
    """The cells of points on a level, as what `_corner` needs."""
    resolution = tl.load(places + 3 * level)
    x, a, da = _axis(p[0], resolution)
    y, b, db = _axis(p[1], resolution)
    z, c, dc = _axis(p[2], resolution)
    level_of = resolution + 1, tl.load(places + 3 * level + 1), tl.load(places + 3 * level + 2)
    return level_of, (x, y, z), (a, b, c), (da, db, dc)


@triton.jit
def _corner(cells, CORNER: tl.constexpr):
    """Table row, interpolation weight, and the weight's gradient by the point, of a corner 0 to 7 of cells."""
    level, cell, t, slope = cells
    x, y, z = cell[0] + (CORNER & 1), cell[1] + (CORNER >> 1 & 1), cell[2] + (CORNER >> 2)
    hashed = x.to(tl.uint32) ^ (y.to(tl.uint32) * _Y) ^ (z.to(tl.uint32) * _Z)
    dense = x + level[0] * (y + level[0] * z)
    row = level[1] + tl.where(level[2] != 0, (hashed & level[2].to(tl.uint32)).to(tl.int32), dense)
    a = t[0] if CORNER & 1 else 1.0 - t[0]
    b = t[1] if CORNER & 2 else 1.0 - t[1]
    c = t[2] if CORNER & 4 else 1.0 - t[2]
    da = slope[0] if CORNER & 1 else -slope[0]
    db = slope[1] if CORNER & 2 else -slope[1]
    dc = slope[2] if CORNER & 4 else -slope[2]
    return row, a * b * c, (da * b * c, a * db * c, a * b * dc)


@triton.jit
def _features(row, there):
    """Where eight features of rows are, in an array of rows of eight; and which of them are there."""
    return row[:, None] * 8 + tl.arange(0, 8)[None, :], there[:, None]


@triton.jit
def _level_columns(i, level, WIDTH: tl.constexpr):
    """Where the features of a level are in encoded points."""
    return i[:, None] * WIDTH + 8 + 8 * level + tl.arange(0, 8)[None, :]


@triton.jit(do_not_specialize=["n"], do_not_specialize_on_alignment=["p", "v"])
def encode(places, table, level_weights, p, v, e, n, WIDTH: tl.constexpr, ALONG: tl.constexpr, BLOCK: tl.constexpr):
    """Encode n points, one level a program; or, if ALONG, the derivative of that in the directions `v`."""
    level = tl.program_id(1)
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = i < n
    q, d = vector(p, i, there), vector(v, i, there)
    total = tl.zeros((BLOCK, 8), tl.float32)
    weight = tl.load(level_weights + level)
    if weight != 0.0:
        cells = _cells(places, level, q)
        for CORNER in tl.static_range(8):
            row, share, slope = _corner(cells, CORNER)
            if ALONG:
                share = dot(slope, d)
            at, some = _features(row, there)
            total += (weight * share)[:, None] * tl.load(table + at, some, 0.0)
    tl.store(e + _level_columns(i, level, WIDTH), total, there[:, None])
    if level == 0:
        own = clamped(q[0]), clamped(q[1]), clamped(q[2])
        if ALONG:
            x, y, z = own[0] == q[0], own[1] == q[1], own[2] == q[2]
            own = tl.where(x, d[0], 0.0), tl.where(y, d[1], 0.0), tl.where(z, d[2], 0.0)
        for AXIS in tl.static_range(3):
            tl.store(e + i * WIDTH + 5 + AXIS, own[AXIS], there)


@triton.jit(do_not_specialize=["n", "count"], do_not_specialize_on_alignment=["p", "outward", "dp"])
def to_points(
    places, table, level_weights, p, d, outward, dp, n, count,
    LEVELS: tl.constexpr, WIDTH: tl.constexpr, WEIGHTED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Pull adjoints `d` of encoded points back to the n points; those from `count` on get 0.

    Outside of the box the slope of the distance to it is added, times `outward` if WEIGHTED.
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there, some = i < n, i < count
    q = vector(p, i, some)
    off = minus(q, (clamped(q[0]), clamped(q[1]), clamped(q[2])))
    distance = length(off)
    g = tl.where(distance > 0.0, 1.0 / tl.maximum(distance, 1e-30), 0.0)
    if WEIGHTED:
        g *= tl.load(outward + i, some, 0.0)
    x = tl.where(off[0] == 0.0, tl.load(d + i * WIDTH + 5, some, 0.0), g * off[0])
    y = tl.where(off[1] == 0.0, tl.load(d + i * WIDTH + 6, some, 0.0), g * off[1])
    z = tl.where(off[2] == 0.0, tl.load(d + i * WIDTH + 7, some, 0.0), g * off[2])
    for level in range(LEVELS):
        weight = tl.load(level_weights + level)
        if weight != 0.0:
            cells = _cells(places, level, q)
            by_features = weight * tl.load(d + _level_columns(i, level, WIDTH), some[:, None], 0.0)
            for CORNER in tl.static_range(8):
                row, _, slope = _corner(cells, CORNER)
                at, mask = _features(row, some)
                value = tl.sum(by_features * tl.load(table + at, mask, 0.0), 1)
                x += value * slope[0]
                y += value * slope[1]
                z += value * slope[2]
    store(dp, i, (x, y, z), there)


@triton.jit(do_not_specialize=["n", "first"], do_not_specialize_on_alignment=["p", "v"])
def scatter(
    places, level_weights, p, d, v, gradient, n, first, WIDTH: tl.constexpr, BLOCK: tl.constexpr
):  # fmt: skip
    """Add adjoints `d` of encoded points to the table's gradient, one level a program.

    Points from `first` on also have directions `v`, whose encodings' adjoints are the rows of `d` from n on.
    """
    level = tl.program_id(1)
    weight = tl.load(level_weights + level)
    if weight != 0.0:
        i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
        there, also = i < n, (i >= first) & (i < n)
        k = i - first
        by_value = weight * tl.load(d + _level_columns(i, level, WIDTH), there[:, None], 0.0)
        by_slope = weight * tl.load(d + _level_columns(n + k, level, WIDTH), also[:, None], 0.0)
        direction = vector(v, k, also)
        # most samples of a sharp surface are in free space, or deep behind it
        there = there & (also | (tl.max(tl.abs(by_value), 1) != 0.0))
        cells = _cells(places, level, vector(p, i, there))
        for CORNER in tl.static_range(8):
            row, share, slope = _corner(cells, CORNER)
            at, some = _features(row, there)
            change = share[:, None] * by_value + dot(slope, direction)[:, None] * by_slope
            tl.atomic_add(gradient + at, change, some, sem="relaxed")


# The activation `knee`, a ReLU with a rounded corner of half-width `w`: with `t = clamp((z + w) / 2 w, 0, 1)` it is
# `w t^3 (2 - t) + max(z - w, 0)`, its slope is `t^2 (3 - 2 t)`, and its second derivative `3 t (1 - t) / w`. The
# kernels take rows of H numbers, the width of a hidden layer, in tiles of BLOCK rows and COLUMNS >= H columns.


@triton.jit
def _knee(z, w):
    """The activation, its slope, and its second derivative."""
    t = tl.minimum(tl.maximum(0.5 * z / w + 0.5, 0.0), 1.0)
    return w * t * t * t * (2.0 - t) + tl.maximum(z - w, 0.0), t * t * (3.0 - 2.0 * t), 3.0 * t * (1.0 - t) / w


@triton.jit
def _tile(n, H: tl.constexpr, COLUMNS: tl.constexpr, BLOCK: tl.constexpr):
    """Row numbers of a program, column numbers, where the elements of such rows are, and which of them are there."""
    i, j = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, COLUMNS)
    return i, j, i[:, None] * H + j[None, :], (i < n)[:, None] & (j < H)[None, :]


@triton.jit(do_not_specialize=["n"])
def activate(z, bias, w, a, n, H: tl.constexpr, COLUMNS: tl.constexpr, BLOCK: tl.constexpr):
    """Add the bias to the pre-activations `z`, and write the activations `a`."""
    _, j, at, there = _tile(n, H, COLUMNS, BLOCK)
    x = tl.load(z + at, there, 0.0) + tl.load(bias + j, j < H, 0.0)[None, :]
    tl.store(z + at, x, there)
    tl.store(a + at, _knee(x, w)[0], there)


@triton.jit(do_not_specialize=["n"])
def through(x, z, w, out, n, H: tl.constexpr, COLUMNS: tl.constexpr, BLOCK: tl.constexpr):
    """`out = x` times the activation's slope at `z`."""
    _, _, at, there = _tile(n, H, COLUMNS, BLOCK)
    tl.store(out + at, tl.load(x + at, there, 0.0) * _knee(tl.load(z + at, there, 0.0), w)[1], there)


@triton.jit(do_not_specialize=["n", "first"], do_not_specialize_on_alignment=["p", "f"])
def top(z, bias, weight, last_bias, w, p, f, u, n, first, H: tl.constexpr, COLUMNS: tl.constexpr, BLOCK: tl.constexpr):
    """From the last pre-activations `z`, to which the bias is added, to the field `f`.

    From point `first` on, `u` are the field's derivatives by the pre-activations.
    """
    i, j, at, there = _tile(n, H, COLUMNS, BLOCK)
    x = tl.load(z + at, there, 0.0) + tl.load(bias + j, j < H, 0.0)[None, :]
    share = tl.load(weight + j, j < H, 0.0)[None, :]
    a, slope, _ = _knee(x, w)
    q = vector(p, i, i < n)
    outside = length(minus(q, (clamped(q[0]), clamped(q[1]), clamped(q[2]))))
    tl.store(z + at, x, there)
    tl.store(f + i, tl.sum(share * a, 1) + tl.load(last_bias) + outside, i < n)
    tl.store(u + at - first * H, share * slope, there & (i >= first)[:, None])


@triton.jit(do_not_specialize=["n", "first"], do_not_specialize_on_alignment=["g", "by_last_bias"])
def adjoint(
    d, g, z, h, z_dot, w, out, by_bias, by_weight, by_last_bias, n, first,
    TOP: tl.constexpr, H: tl.constexpr, COLUMNS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Adjoint of pre-activations `z` from that of the activations, `d`; adds that of the bias.

    In the TOP layer the activations' adjoint is `g` times the last weights, which are in `d` and in `h`; those of the
    last layer are added, too. From point `first` on the loss also depends on derivatives along a direction: `h` is that
    of the field by the activations, `z_dot` that of the pre-activations along it.
    """
    i, j, at, there = _tile(n, H, COLUMNS, BLOCK)
    also, of_slopes = there & (i >= first)[:, None], at - first * H
    a, slope, bend = _knee(tl.load(z + at, there, 0.0), w)
    dot_z = tl.load(z_dot + of_slopes, also, 0.0)
    if TOP:
        by_value, share = tl.load(g + i, i < n, 0.0), tl.load(d + j, j < H, 0.0)[None, :]
        x = by_value[:, None] * share * slope + bend * dot_z * share
        by_share = tl.where(there, by_value[:, None] * a, 0.0) + slope * dot_z
        tl.atomic_add(by_weight + j, tl.sum(by_share, 0), j < H, sem="relaxed")
        tl.atomic_add(by_last_bias, tl.sum(by_value, 0), sem="relaxed")
    else:
        x = tl.load(d + at, there, 0.0) * slope + bend * dot_z * tl.load(h + of_slopes, also, 0.0)
    tl.store(out + at, x, there)
    tl.atomic_add(by_bias + j, tl.sum(tl.where(there, x, 0.0), 0), j < H, sem="relaxed")


@triton.jit(do_not_specialize=["rows"])
def row_adam(
    table, gradient, moments, steps, lr, log_beta1, log_beta2, most_steps, eps, rows, BLOCK: tl.constexpr
):  # fmt: skip
    """Adam for the rows (of eight) whose gradient is not exactly zero; clears the gradient.

    `moments` [rows, 2, 8]: mean and mean square of the gradient; `steps` counts the steps of each row.
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    at, there = _features(i, i < rows)
    g = tl.load(gradient + at, there, 0.0)
    moved = (tl.sum(tl.abs(g), 1) != 0.0) & (i < rows)
    some = moved[:, None]
    t = tl.minimum(tl.load(steps + i, moved, 0.0) + 1.0, most_steps)
    mean_at, square_at = _features(2 * i, moved)[0], _features(2 * i + 1, moved)[0]
    mean, square = tl.load(moments + mean_at, some, 0.0), tl.load(moments + square_at, some, 0.0)
    mean += one_minus_exp(log_beta1) * (g - mean)
    square += one_minus_exp(log_beta2) * (g * g - square)
    rate = tl.load(lr) / one_minus_exp(t * log_beta1)
    root = 1.0 / tl.sqrt(one_minus_exp(t * log_beta2))
    x = tl.load(table + at, some, 0.0)
    tl.store(table + at, x - rate[:, None] * mean / (tl.sqrt(square) * root[:, None] + eps), some)
    tl.store(moments + mean_at, mean, some)
    tl.store(moments + square_at, square, some)
    tl.store(steps + i, t, moved)
    tl.store(gradient + at, tl.zeros_like(g), some)


@dataclass(frozen=True)
class _Kept:
    """Of n points, k of them with gradients; h is the width of a hidden layer.

    Rows of values come first, then k rows for derivatives, which the pull-back fills where an evaluation does not.
    """

    p: Float[Tensor, "n 3"]
    first: int
    encoded: Float[Tensor, "n+k width"]
    inputs: list[Tensor]  # what hidden layers take: encoded points, then activations [n + k, h]
    z: list[Tensor]  # pre-activations [n, h] of the hidden layers
    d: list[Tensor]  # derivatives of the field by them, in the last k of n + k rows; the pull-back fills the others
    h: list[Tensor]  # derivatives of the field by the activations [k, h] of all hidden layers but the last


class TritonField:
    """`FieldBackend` for float32 with 8 features per level."""

    def __init__(self, layout: GridLayout, knee: float):
        self.layout = layout
        self.knee = knee
        self._width = 8 + FEATURES * layout.levels

    def evaluate_all(self, state: FieldState, p: Float[Tensor, "n 3"], first: int) -> tuple[Tensor, Tensor, _Kept]:
        """See `FieldBackend`."""
        n, k = len(p), len(p) - first
        weights, biases = _layers(state)
        *lower, last = range(len(weights) - 1)
        rows = _Rows(len(weights[0]), self.knee)
        encoded, f, gradient = p.new_empty(n + k, self._width), p.new_empty(n), p.new_empty(k, 3)
        self._encode(state, p, p, encoded, along=False)
        inputs, z = [encoded[:, _OWN:]], [torch.mm(encoded[:n, _OWN:], weights[0].T)]
        for layer in lower:
            inputs.append(p.new_empty(n + k, rows.width))
            rows.launch(activate, n, z[layer], biases[layer], rows.knee, inputs[-1], n)
            z.append(torch.mm(inputs[-1][:n], weights[layer + 1].T))
        unused = encoded  # not an output, which would keep the graph of the step that keeps it
        d, h = [p.new_empty(n + k, rows.width) if k else unused for _ in z], [unused for _ in z]
        rows.launch(top, n, z[last], biases[last], weights[-1], biases[-1], rows.knee, p, f, d[last][n:], n, first)
        if k:
            for layer in reversed(lower):
                h[layer] = torch.mm(d[layer + 1][n:], weights[layer + 1])
                rows.launch(through, k, h[layer], z[layer][first:], rows.knee, d[layer][n:], k)
            by_encoded = p.new_empty(k, self._width)
            torch.mm(d[0][n:], weights[0], out=by_encoded[:, _OWN:])
            self._to_points(state, p[first:], by_encoded, None, k, gradient)
        return f, gradient, _Kept(p.detach(), first, encoded, inputs, z, d, h)

    def pull_back_all(
        self, state: FieldState, kept: _Kept, g: Float[Tensor, "n"], v: Float[Tensor, "k 3"], points: bool, to: Target
    ) -> Pulled:
        """See `FieldBackend`."""
        p, first, n, k, z = kept.p, kept.first, len(kept.p), len(kept.p) - kept.first, kept.z
        weights, _ = _layers(state)
        last = len(z) - 1
        rows = _Rows(len(weights[0]), self.knee)
        d, z_dot = kept.d, list(kept.z)
        if k:
            self._encode(state, p[first:], v, kept.encoded[n:], along=True)
            for layer in range(len(z)):
                z_dot[layer] = torch.mm(kept.inputs[layer][n:], weights[layer].T)
                if layer < last:
                    rows.launch(through, k, z_dot[layer], z[layer][first:], rows.knee, kept.inputs[layer + 1][n:], k)
        else:
            d = [torch.empty_like(x) for x in z]
        sums = p.new_zeros(rows.width * (len(z) + 1) + 1)
        *by_bias, by_last = sums[:-1].split(rows.width)
        by_weight: list[Tensor] = []
        upstream = weights[-1]
        for layer in reversed(range(len(z))):
            arrays = (upstream, g, z[layer], kept.h[layer], z_dot[layer], rows.knee, d[layer], by_bias[layer])
            rows.launch(adjoint, n, *arrays, by_last, sums[-1:], n, first, TOP=layer == last)
            if to.parameters:
                by_weight.insert(0, torch.mm(d[layer].T, kept.inputs[layer]))
            if layer:
                upstream = torch.mm(d[layer][:n], weights[layer])
        by_encoded = torch.empty_like(kept.encoded)
        torch.mm(d[0], weights[0], out=by_encoded[:, _OWN:])
        if to.table is not None:
            size = block(_POINTS, n)
            grid = (triton.cdiv(n, size), self.layout.levels)
            arrays = (state.places, state.level_weights, p, by_encoded, v, to.table)
            launch(scatter, grid, *arrays, n, first, WIDTH=self._width, BLOCK=size)
            if to.marks is not None and len(to.marks):  # a table on a GPU has none
                to.marks.fill_(1)
        dp = torch.empty_like(p) if points else None
        if dp is not None:
            self._to_points(state, p, by_encoded, g, first, dp)
        if not to.parameters:
            return Pulled(dp, None)
        of_layers = [x for pair in zip(by_weight, by_bias, strict=True) for x in pair]
        return Pulled(dp, (*of_layers, by_last[None], sums[-1:]))

    def _encode(self, state: FieldState, p: Tensor, v: Tensor, e: Tensor, along: bool) -> None:
        size = block(_POINTS, len(p))
        arrays = (state.places, state.table, state.level_weights, p, v, e)
        grid = (triton.cdiv(len(p), size), self.layout.levels)
        launch(encode, grid, *arrays, len(p), WIDTH=self._width, ALONG=along, BLOCK=size)

    def _to_points(self, state: FieldState, p: Tensor, d: Tensor, g: Tensor | None, count: int, dp: Tensor) -> None:
        size = block(_POINTS, len(p))
        arrays = (state.places, state.table, state.level_weights, p, d, p if g is None else g, dp)
        constants = {"LEVELS": self.layout.levels, "WIDTH": self._width, "WEIGHTED": g is not None, "BLOCK": size}
        launch(to_points, triton.cdiv(len(p), size), *arrays, len(p), count, **constants)


@dataclass(frozen=True)
class _Rows:
    """Rows as wide as a hidden layer."""

    width: int
    knee: float

    def launch(self, kernel: Any, n: int, *arguments: Any, **constants: Any) -> None:
        """Launch a kernel for n rows."""
        columns = triton.next_power_of_2(self.width)
        size = block(max(_ELEMENTS // columns, 1), n)
        launch(kernel, triton.cdiv(n, size), *arguments, **constants, H=self.width, COLUMNS=columns, BLOCK=size)


def step_table(
    table: Tensor, gradient: Tensor, moments: Tensor, steps: Tensor, lr: Tensor, betas: tuple[float, float],
    most_steps: int, eps: float,
) -> None:  # fmt: skip
    """Adam's step of a feature table [rows, 8], see `RowAdam`; clears the gradient. `lr` [1] is read on the device."""
    size = block(_POINTS, len(table))
    logarithms = [math.log(beta) if beta > 0 else -math.inf for beta in betas]
    arrays = (table, gradient, moments, steps, lr)
    launch(
        row_adam, triton.cdiv(len(table), size), *arrays, *logarithms, float(most_steps), eps, len(table), BLOCK=size
    )


def _layers(state: FieldState) -> tuple[list[Tensor], list[Tensor]]:
    """Weights and biases, detached."""
    return [w.detach() for w in state.mlp[0::2]], [b.detach() for b in state.mlp[1::2]]
