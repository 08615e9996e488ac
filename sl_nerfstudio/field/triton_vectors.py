# pyright: basic, reportIndexIssue=false, reportOperatorIssue=false, reportArgumentType=false
"""Vectors of three numbers in Triton: tuples of tiles, one tile for each coordinate; what several kernels need."""

import triton
import triton.language as tl


@triton.jit
def probe(x):
    """Add one to a number: whether kernels can be compiled and run at all."""
    tl.store(x, tl.load(x) + 1.0)


@triton.jit
def vector(p, i, there):
    """Row i of an array (n, 3); zeros where nothing is there."""
    return tl.load(p + 3 * i, there, 0.0), tl.load(p + 3 * i + 1, there, 0.0), tl.load(p + 3 * i + 2, there, 0.0)


@triton.jit
def store(p, i, v, there):
    """Write row i of an array (n, 3)."""
    tl.store(p + 3 * i, v[0], there)
    tl.store(p + 3 * i + 1, v[1], there)
    tl.store(p + 3 * i + 2, v[2], there)


@triton.jit
def dot(a, b):
    """Inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@triton.jit
def cross(a, b):
    """Cross product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@triton.jit
def length(a):
    """Euclidean norm."""
    return tl.sqrt(dot(a, a))


@triton.jit
def minus(a, b):
    """Difference."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@triton.jit
def along(a, t, b):
    """`a + t b`."""
    return a[0] + t * b[0], a[1] + t * b[1], a[2] + t * b[2]


@triton.jit
def columns(a):
    """A vector for each row of a tile, for all of the row's columns."""
    return a[0][:, None], a[1][:, None], a[2][:, None]


@triton.jit
def summed(a):
    """The sum over the columns of a tile."""
    return tl.sum(a[0], 1), tl.sum(a[1], 1), tl.sum(a[2], 1)


@triton.jit
def clamped(x):
    """`x` in [-1, 1]; not a number becomes -1, so that nothing is read outside of an array."""
    y = tl.where(x > -1.0, x, -1.0)
    return tl.where(y < 1.0, y, 1.0)


@triton.jit
def finite(x):
    """Whether `x` is a number, and not infinite."""
    return tl.abs(x) < float("inf")


@triton.jit
def one_minus_exp(x):
    """`1 - exp(x)` for `x <= 0`, as exact for small `x`."""
    series = -x * (1.0 + x * (0.5 + x * (1.0 / 6.0 + x * (1.0 / 24.0 + x * (1.0 / 120.0 + x / 720.0)))))
    return tl.where(x > -0.3, series, 1.0 - tl.exp(x))
