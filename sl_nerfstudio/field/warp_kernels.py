# type: ignore  (Warp compiles what is below; its types are not those of Python)
"""What lies between the perceptron's matrix products, in Warp: the activation, its derivatives, and the first layer.

The activation `knee` is a ReLU with a rounded corner of half-width `w`: with `t = clamp((z + w) / 2 w, 0, 1)` it is
`w t^3 (2 - t) + max(z - w, 0)`, its slope is `t^2 (3 - 2 t)`, and its second derivative `3 t (1 - t) / w`.
"""

import warp as wp

from sl_nerfstudio.field.device_kernels import kernel, part, structure
from sl_nerfstudio.field.hash_grid import PRIMES

# The feature grid in Warp: encode points, their directional derivatives, and the adjoints of both.
#
# An encoded point has `FIRST` columns of its own (0..2 the point, 3 the constant 1, which carries the first layer's
# bias, 4..7 zero), then eight per level: the layout of the compiled CPU kernels. One thread has one point and one
# level, or all levels of a point where it sums over them. Points that are not numbers read the table's first cell.
# `places` has a row per level (see `HashGrid`); `smooth` is 1 for smoothstep weights.

FEATURES = 8
FIRST = 8
_Y, _Z = wp.constant(wp.uint32(PRIMES[1])), wp.constant(wp.uint32(PRIMES[2]))

vec8 = wp.types.vector(8, wp.float32)


Cell = structure(
    "Cell",
    __name__,
    x=wp.int32,  # the cell's lowest corner
    y=wp.int32,
    z=wp.int32,
    t=wp.vec3,  # interpolation weights of the far corners
    slope=wp.vec3,  # and their derivatives by the point's coordinates
)


@part
def clamped(x: wp.float32):
    """`x` in [-1, 1]; not a number becomes -1, so that nothing is read outside the table."""
    y = wp.where(x > -1.0, x, -1.0)
    return wp.where(y < 1.0, y, 1.0)


@part
def in_box(p: wp.vec3):
    """The nearest point of [-1, 1]^3."""
    return wp.vec3(clamped(p[0]), clamped(p[1]), clamped(p[2]))


@part
def inside(x: wp.float32):
    """Derivative of `clamped`."""
    return wp.where(x >= -1.0 and x <= 1.0, 1.0, 0.0)


@part
def is_inside(p: wp.vec3):
    """Derivative of `in_box`, of each coordinate."""
    return wp.vec3(inside(p[0]), inside(p[1]), inside(p[2]))


@part
def cell_of(places: wp.array2d(dtype=wp.int32), smooth: wp.int32, level: wp.int32, p: wp.vec3):
    """The cell of a point on a level."""
    r = places[level, 0]
    half = 0.5 * wp.float32(r)
    u = wp.vec3((clamped(p[0]) + 1.0) * half, (clamped(p[1]) + 1.0) * half, (clamped(p[2]) + 1.0) * half)
    cell = Cell()
    cell.x = wp.min(wp.int32(u[0]), r - 1)
    cell.y = wp.min(wp.int32(u[1]), r - 1)
    cell.z = wp.min(wp.int32(u[2]), r - 1)
    t = u - wp.vec3(wp.float32(cell.x), wp.float32(cell.y), wp.float32(cell.z))
    slope = half * is_inside(p)
    if smooth != 0:
        one = wp.vec3(1.0, 1.0, 1.0)
        slope = wp.cw_mul(slope, 6.0 * wp.cw_mul(t, one - t))
        t = wp.cw_mul(wp.cw_mul(t, t), 3.0 * one - 2.0 * t)
    cell.t = t
    cell.slope = slope
    return cell


@part
def row_of(places: wp.array2d(dtype=wp.int32), level: wp.int32, cell: Cell, corner: wp.int32):
    """Table row of a corner of a cell; x varies fastest."""
    x = cell.x + (corner & 1)
    y = cell.y + ((corner >> 1) & 1)
    z = cell.z + ((corner >> 2) & 1)
    mask = places[level, 2]
    row = wp.int32(0)
    if mask != 0:
        h = wp.uint32(x) ^ (wp.uint32(y) * _Y) ^ (wp.uint32(z) * _Z)
        row = wp.int32(h & wp.uint32(mask))
    else:
        side = places[level, 0] + 1
        row = x + side * (y + side * z)
    return row + places[level, 1]


@part
def weight_of(cell: Cell, corner: wp.int32):
    """Interpolation weight of a corner."""
    x = wp.where((corner & 1) != 0, cell.t[0], 1.0 - cell.t[0])
    y = wp.where((corner & 2) != 0, cell.t[1], 1.0 - cell.t[1])
    z = wp.where((corner & 4) != 0, cell.t[2], 1.0 - cell.t[2])
    return x * y * z


@part
def slope_of(cell: Cell, corner: wp.int32):
    """Derivative of a corner's weight with respect to the point."""
    x = wp.where((corner & 1) != 0, cell.t[0], 1.0 - cell.t[0])
    y = wp.where((corner & 2) != 0, cell.t[1], 1.0 - cell.t[1])
    z = wp.where((corner & 4) != 0, cell.t[2], 1.0 - cell.t[2])
    dx = wp.where((corner & 1) != 0, cell.slope[0], -cell.slope[0])
    dy = wp.where((corner & 2) != 0, cell.slope[1], -cell.slope[1])
    dz = wp.where((corner & 4) != 0, cell.slope[2], -cell.slope[2])
    return wp.vec3(dx * y * z, x * dy * z, x * y * dz)


@kernel
def encode(
    places: wp.array2d(dtype=wp.int32),
    smooth: wp.int32,
    table: wp.array(dtype=vec8),
    level_weights: wp.array(dtype=wp.float32),
    p: wp.array(dtype=wp.vec3),
    last_bias: wp.array(dtype=wp.float32),
    e: wp.array2d(dtype=wp.float32),
    f: wp.array(dtype=wp.float32),
):
    """Encoded points `e`; `f` starts with what does not depend on them: the last bias and the distance to the box."""
    level, i = wp.tid()
    q = p[i]
    if level == 0:
        c = in_box(q)
        for a in range(3):
            e[i, a] = c[a]
        e[i, 3] = 1.0
        for a in range(4, FIRST):
            e[i, a] = 0.0
        f[i] = last_bias[0] + wp.length(q - c)
    total = vec8()
    weight = level_weights[level]
    if weight != 0.0:
        cell = cell_of(places, smooth, level, q)
        for corner in range(8):
            total += weight_of(cell, corner) * table[row_of(places, level, cell, corner)]
    column = FIRST + FEATURES * level
    for j in range(FEATURES):
        e[i, column + j] = weight * total[j]


@kernel
def encode_along(
    places: wp.array2d(dtype=wp.int32),
    smooth: wp.int32,
    table: wp.array(dtype=vec8),
    level_weights: wp.array(dtype=wp.float32),
    p: wp.array(dtype=wp.vec3),
    v: wp.array(dtype=wp.vec3),
    e_dot: wp.array2d(dtype=wp.float32),
):
    """Derivative `e_dot` of the encoded points in the directions `v`."""
    level, i = wp.tid()
    q = p[i]
    if level == 0:
        c = wp.cw_mul(v[i], is_inside(q))
        for a in range(3):
            e_dot[i, a] = c[a]
        for a in range(3, FIRST):
            e_dot[i, a] = 0.0
    total = vec8()
    weight = level_weights[level]
    if weight != 0.0:
        cell = cell_of(places, smooth, level, q)
        for corner in range(8):
            total += wp.dot(slope_of(cell, corner), v[i]) * table[row_of(places, level, cell, corner)]
    column = FIRST + FEATURES * level
    for j in range(FEATURES):
        e_dot[i, column + j] = weight * total[j]


@kernel
def to_points(
    places: wp.array2d(dtype=wp.int32),
    smooth: wp.int32,
    table: wp.array(dtype=vec8),
    level_weights: wp.array(dtype=wp.float32),
    p: wp.array(dtype=wp.vec3),
    de: wp.array2d(dtype=wp.float32),
    outward: wp.array(dtype=wp.float32),
    count: wp.int32,
    dp: wp.array(dtype=wp.vec3),
):
    """Adjoint `dp` of the points: that of the encoded points, and `outward` (or 1) times the slope of the distance.

    It is 0 for points from `count` on.
    """
    i = wp.tid()
    if i >= count:
        dp[i] = wp.vec3()
        return
    q = p[i]
    step = q - in_box(q)
    distance = wp.length(step)
    total = wp.cw_mul(wp.vec3(de[i, 0], de[i, 1], de[i, 2]), is_inside(q))
    if distance != 0.0:  # also true for what is not a number
        g = wp.float32(1.0)
        if outward.shape[0] > 0:
            g = outward[i]
        total += (g / distance) * step
    for level in range(places.shape[0]):
        weight = level_weights[level]
        if weight != 0.0:
            cell = cell_of(places, smooth, level, q)
            d = vec8()
            for j in range(FEATURES):
                d[j] = weight * de[i, FIRST + FEATURES * level + j]
            for corner in range(8):
                total += wp.dot(d, table[row_of(places, level, cell, corner)]) * slope_of(cell, corner)
    dp[i] = total


@kernel
def scatter(
    places: wp.array2d(dtype=wp.int32),
    smooth: wp.int32,
    level_weights: wp.array(dtype=wp.float32),
    p: wp.array(dtype=wp.vec3),
    de: wp.array2d(dtype=wp.float32),
    first: wp.int32,
    v: wp.array(dtype=wp.vec3),
    u: wp.array2d(dtype=wp.float32),
    gradient: wp.array(dtype=vec8),
    marks: wp.array(dtype=wp.uint8),
):
    """Add the adjoints `de` of the encoded points to the table's gradient, and mark its rows if there are marks.

    Points from `first` on also have the directions `v`, whose derivatives of the encoded points have the adjoints `u`.
    """
    level, i = wp.tid()
    weight = level_weights[level]
    if weight == 0.0:
        return
    column = FIRST + FEATURES * level
    d = vec8()
    for j in range(FEATURES):
        d[j] = weight * de[i, column + j]
    if i < first and wp.dot(d, d) == 0.0:
        return  # most samples of a sharp surface: in free space, or deep behind it
    cell = cell_of(places, smooth, level, p[i])
    along = vec8()
    direction = wp.vec3()
    if i >= first:
        direction = v[i - first]
        for j in range(FEATURES):
            along[j] = weight * u[i - first, column + j]
    for corner in range(8):
        row = row_of(places, level, cell, corner)
        change = weight_of(cell, corner) * d
        if i >= first:
            change += wp.dot(slope_of(cell, corner), direction) * along
        wp.atomic_add(gradient, row, change)
        if marks.shape[0] > 0:
            marks[row] = wp.uint8(1)


# The optimiser's step for a feature table, in Warp: one thread per row, rows without a gradient are left alone.


@part
def one_minus_exp(x: wp.float32):
    """`1 - exp(x)` for `x <= 0`, as exact for small `x`."""
    series = -x * (1.0 + x * (0.5 + x * (1.0 / 6.0 + x * (1.0 / 24.0 + x * (1.0 / 120.0 + x / 720.0)))))
    return wp.where(x > -0.3, series, 1.0 - wp.exp(x))


@kernel
def row_adam(
    table: wp.array(dtype=vec8),
    gradient: wp.array(dtype=vec8),
    moments: wp.array2d(dtype=vec8),
    steps: wp.array(dtype=wp.float32),
    lr: wp.array(dtype=wp.float32),
    log_beta1: wp.float32,
    log_beta2: wp.float32,
    most_steps: wp.float32,
    eps: wp.float32,
):
    """Adam for the rows whose gradient is not exactly zero; clears the gradient.

    `moments` [row, 2]: mean and mean square of the gradient; `steps` counts the steps of each row.
    """
    row = wp.tid()
    g = gradient[row]
    if wp.dot(wp.abs(g), vec8(1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0)) == 0.0:
        return
    rest1, rest2 = one_minus_exp(log_beta1), one_minus_exp(log_beta2)
    t = wp.min(steps[row] + 1.0, most_steps)
    steps[row] = t
    m = moments[row, 0] + rest1 * (g - moments[row, 0])
    s = moments[row, 1] + rest2 * (wp.cw_mul(g, g) - moments[row, 1])
    moments[row, 0] = m
    moments[row, 1] = s
    rate = lr[0] / one_minus_exp(t * log_beta1)
    root = 1.0 / wp.sqrt(one_minus_exp(t * log_beta2))
    x = table[row]
    for j in range(8):
        x[j] = x[j] - rate * m[j] / (wp.sqrt(s[j]) * root + eps)
    table[row] = x
    gradient[row] = vec8()


_FIRST = wp.constant(8)  # column of the first level, see `grid`
_OWN = wp.constant(3)  # columns of the point itself
_ONE = wp.constant(3)  # column of the constant 1


@part
def place(z: wp.float32, w: wp.float32):
    """Position `t` on the rounded corner."""
    return wp.clamp(0.5 * z / w + 0.5, 0.0, 1.0)


@part
def slope(t: wp.float32):
    """The activation's derivative."""
    return t * t * (3.0 - 2.0 * t)


@kernel
def pack_first(
    weight: wp.array2d(dtype=wp.float32), bias: wp.array(dtype=wp.float32), packed: wp.array2d(dtype=wp.float32)
):
    """The first layer's weights in the order of the encoded columns, the bias at the constant's."""
    j, column = wp.tid()
    x = wp.float32(0.0)
    if column < _OWN:
        x = weight[j, column]
    elif column == _ONE:
        x = bias[j]
    elif column >= _FIRST:
        x = weight[j, column - _FIRST + _OWN]
    packed[j, column] = x


@kernel
def unpack_first(
    packed: wp.array2d(dtype=wp.float32), weight: wp.array2d(dtype=wp.float32), bias: wp.array(dtype=wp.float32)
):
    """The opposite of `pack_first`, one thread per column of `packed`."""
    j, column = wp.tid()
    if column < _OWN:
        weight[j, column] = packed[j, column]
    elif column == _ONE:
        bias[j] = packed[j, column]
    elif column >= _FIRST:
        weight[j, column - _FIRST + _OWN] = packed[j, column]


@kernel
def activate(
    z: wp.array2d(dtype=wp.float32),
    bias: wp.array(dtype=wp.float32),
    w: wp.float32,
    a: wp.array2d(dtype=wp.float32),
):
    """Add the bias, if there is one, to the pre-activations `z`, and write the activations `a`."""
    i, j = wp.tid()
    x = z[i, j]
    if bias.shape[0] > 0:
        x += bias[j]
        z[i, j] = x
    t = place(x, w)
    a[i, j] = w * t * t * t * (2.0 - t) + wp.max(x - w, 0.0)


@kernel
def through(
    x: wp.array2d(dtype=wp.float32), z: wp.array2d(dtype=wp.float32), w: wp.float32, out: wp.array2d(dtype=wp.float32)
):
    """`out = x` times the activation's slope at `z`; `x` may have one row for all points."""
    i, j = wp.tid()
    row = wp.where(x.shape[0] == 1, 0, i)
    out[i, j] = x[row, j] * slope(place(z[i, j], w))


@kernel
def adjoint(
    d: wp.array2d(dtype=wp.float32),
    g: wp.array(dtype=wp.float32),
    z: wp.array2d(dtype=wp.float32),
    first: wp.int32,
    h: wp.array2d(dtype=wp.float32),
    z_dot: wp.array2d(dtype=wp.float32),
    w: wp.float32,
    out: wp.array2d(dtype=wp.float32),
):
    """Adjoint of pre-activations, from that of the activations, `d`; where there is `g`, `g[i] d[0]`.

    From point `first` on the loss also depends on derivatives: `h` is that of the field by the activations (it may have
    one row for all points), and `z_dot` the directional one of the pre-activations.
    """
    i, j = wp.tid()
    upstream = wp.float32(0.0)
    if g.shape[0] > 0:
        upstream = g[i] * d[0, j]
    else:
        upstream = d[i, j]
    t = place(z[i, j], w)
    x = upstream * slope(t)
    if i >= first:
        k = i - first
        row = wp.where(h.shape[0] == 1, 0, k)
        x += 3.0 * t * (1.0 - t) / w * z_dot[k, j] * h[row, j]
    out[i, j] = x
