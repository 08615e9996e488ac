# pyright: basic, reportIndexIssue=false, reportOperatorIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
"""Poses, projection and pattern in Triton, for tiles of points; the formulas are those of `geometry/devices.py`.

A pose is its rotation's three columns and its translation, each a vector. `k` are the eight PARAMETERS of a device,
DOE says that it is a projector with a diffractive optical element, DISTORTED whether its lens is not ideal.
"""

import triton
import triton.language as tl

from sl_nerfstudio.field.triton_vectors import along, dot, length


@triton.jit
def pose(T, i, there):
    """Pose i of an array (n, 4, 4)."""
    T += 16 * i
    x = tl.load(T, there, 0.0), tl.load(T + 4, there, 0.0), tl.load(T + 8, there, 0.0)
    y = tl.load(T + 1, there, 0.0), tl.load(T + 5, there, 0.0), tl.load(T + 9, there, 0.0)
    z = tl.load(T + 2, there, 0.0), tl.load(T + 6, there, 0.0), tl.load(T + 10, there, 0.0)
    return x, y, z, (tl.load(T + 3, there, 0.0), tl.load(T + 7, there, 0.0), tl.load(T + 11, there, 0.0))


@triton.jit
def turned(T, d):
    """A direction in the frame to which a pose leads."""
    x = T[0][0] * d[0] + T[1][0] * d[1] + T[2][0] * d[2]
    y = T[0][1] * d[0] + T[1][1] * d[1] + T[2][1] * d[2]
    return x, y, T[0][2] * d[0] + T[1][2] * d[1] + T[2][2] * d[2]


@triton.jit
def turned_back(T, d):
    """A direction in the frame from which a pose leads."""
    return dot(T[0], d), dot(T[1], d), dot(T[2], d)


@triton.jit
def intrinsics(k, i, there):
    """The parameters of device i of an array (n, 8)."""
    k += 8 * i
    lens = (
        tl.load(k + 4, there, 0.0),
        tl.load(k + 5, there, 0.0),
        tl.load(k + 6, there, 0.0),
        tl.load(k + 7, there, 0.0),
    )
    focal = tl.load(k, there, 1.0), tl.load(k + 1, there, 1.0)
    return focal, (tl.load(k + 2, there, 0.0), tl.load(k + 3, there, 0.0)), lens


@triton.jit
def _distort(x, y, lens):
    """Distorted normalised coordinates, and their derivatives: xd by x, either by the other, yd by y."""
    k1, k2, p1, p2 = lens[0], lens[1], lens[2], lens[3]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * k2)
    slope = 2.0 * k1 + 4.0 * k2 * r2
    xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    a = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
    b = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
    d = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
    return xd, yd, a, b, d


@triton.jit
def project(k, p, DOE: tl.constexpr, DISTORTED: tl.constexpr):
    """Of points in the device's axes: whether they have a pixel, the pixel, and its two gradients by the point."""
    norm = length(p)
    lit = -p[2] > 1e-6 * norm
    if DOE:
        q = 1.0 / tl.maximum(norm, 1e-30)
        x, y = p[0] * q, -p[1] * q
        dx = q - x * q * q * p[0], -x * q * q * p[1], -x * q * q * p[2]
        dy = -y * q * q * p[0], -q - y * q * q * p[1], -y * q * q * p[2]
    else:
        q = -1.0 / tl.where(lit, p[2], -1.0)
        x, y = p[0] * q, -p[1] * q
        dx = q, tl.zeros_like(q), x * q
        dy = tl.zeros_like(q), -q, y * q
    if DISTORTED:
        x, y, a, b, d = _distort(x, y, k[2])
        lit = lit & (a * d > b * b) & (a > 0.0)  # not beyond where the polynomial folds back
        dx, dy = (
            (a * dx[0] + b * dy[0], a * dx[1] + b * dy[1], a * dx[2] + b * dy[2]),
            (b * dx[0] + d * dy[0], b * dx[1] + d * dy[1], b * dx[2] + d * dy[2]),
        )
    du = k[0][0] * dx[0], k[0][0] * dx[1], k[0][0] * dx[2]
    dv = k[0][1] * dy[0], k[0][1] * dy[1], k[0][1] * dy[2]
    return lit, k[0][0] * x + k[1][0], k[0][1] * y + k[1][1], du, dv


@triton.jit
def unproject(k, u, v, DOE: tl.constexpr, DISTORTED: tl.constexpr):
    """Unit directions, in the device's axes, of pixels; not numbers where the model has none."""
    xd, yd = (u - k[1][0]) / k[0][0], (v - k[1][1]) / k[0][1]
    x, y = xd, yd
    if DISTORTED:
        for _ in range(12):  # Newton's method, as `undistort`
            ex, ey, a, b, d = _distort(x, y, k[2])
            ex, ey = ex - xd, ey - yd
            det = a * d - b * b
            det = tl.where(tl.abs(det) < 1e-9, 1e-9, det)
            x, y = x - (d * ex - b * ey) / det, y - (a * ey - b * ex) / det
    if DOE:
        return x, -y, -tl.sqrt(1.0 - x * x - y * y)
    q = 1.0 / tl.sqrt(x * x + y * y + 1.0)
    return x * q, -y * q, -q


@triton.jit
def _texel(pattern, row, column, height, width, there):
    """Intensities of pixels of the pattern; 0 outside."""
    there = there & (row >= 0) & (column >= 0) & (row < height) & (column < width)
    return tl.load(pattern + row * width + column, there, 0.0)


@triton.jit
def look_up(pattern, height, width, u, v, there):
    """Bilinear intensity at continuous coordinates (first pixel's centre at 0.5), and its two derivatives."""
    x, y = u - 0.5, v - 0.5
    there = there & (x > -1.0) & (y > -1.0) & (x < width) & (y < height)
    x, y = tl.where(there, x, 0.0), tl.where(there, y, 0.0)
    left, above = tl.floor(x), tl.floor(y)
    column, row, s, t = left.to(tl.int32), above.to(tl.int32), x - left, y - above
    a = _texel(pattern, row, column, height, width, there)
    b = _texel(pattern, row, column + 1, height, width, there)
    c = _texel(pattern, row + 1, column, height, width, there)
    d = _texel(pattern, row + 1, column + 1, height, width, there)
    top, bottom = a + s * (b - a), c + s * (d - c)
    return top + t * (bottom - top), (1.0 - t) * (b - a) + t * (d - c), bottom - top


@triton.jit
def near_and_far(o, d):
    """Distances at which rays enter and leave the unit sphere; see `sphere_interval`."""
    b = dot(o, d)
    half = tl.sqrt(tl.maximum(b * b - dot(o, o) + 1.0, 0.25))
    return tl.maximum(-b - half, 0.0), tl.maximum(-b + half, 1e-3)


@triton.jit
def _of_cache(x, resolution):
    """Along one axis: the cached grid's vertex before coordinates, and how far they are behind it."""
    top = resolution - 1.0
    u = tl.minimum(tl.maximum((x + 1.0) * (0.5 * top), 0.0), top)
    i = tl.minimum(u.to(tl.int32), resolution - 2)
    return i, u - i.to(tl.float32)


@triton.jit
def cached(values, resolution, o, t, d, there):
    """Trilinear values of the cached grid (z, y, x) at distances along rays; outside the box those at its border."""
    p = along(o, t, d)
    i, r = _of_cache(p[0], resolution)
    j, s = _of_cache(p[1], resolution)
    k, t = _of_cache(p[2], resolution)
    value = tl.zeros_like(r)
    for CORNER in tl.static_range(8):
        at = ((k + (CORNER >> 2)) * resolution + j + (CORNER >> 1 & 1)) * resolution + i + (CORNER & 1)
        share = (r if CORNER & 1 else 1.0 - r) * (s if CORNER & 2 else 1.0 - s) * (t if CORNER & 4 else 1.0 - t)
        value += share * tl.load(values + at, there, 0.0)
    return value
