# type: ignore  (Warp compiles what is below; its types are not those of Python)
"""What lies between the perceptron's matrix products, in Warp: the activation, its derivatives, and the first layer.

The activation `knee` is a ReLU with a rounded corner of half-width `w`: with `t = clamp((z + w) / 2 w, 0, 1)` it is
`w t^3 (2 - t) + max(z - w, 0)`, its slope is `t^2 (3 - 2 t)`, and its second derivative `3 t (1 - t) / w`.
"""

import warp as wp

from sl_nerfstudio.device_kernels import kernel, part

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
