# type: ignore  (Warp compiles what is below; its types are not those of Python)
"""Projection into a projector, and its pattern, for one point; the formulas are those of `geometry/devices/`."""

import warp as wp

from sl_nerfstudio.device_kernels import part, structure

_MIN_DEPTH = wp.constant(1e-6)  # as in geometry/devices

Pixel = structure(
    "Pixel",
    __name__,
    lit=wp.int32,  # whether the point has a pixel; else the rest is zero
    uv=wp.vec2,
    du=wp.vec3,  # derivatives by the point, in the projector's axes
    dv=wp.vec3,
)


@part
def project(params: wp.array(dtype=wp.float32), model: wp.int32, distorted: wp.int32, p: wp.vec3):
    """Pixel of a point in the projector's axes; `model` is 0 for the pinhole model and 1 for the DOE."""
    pixel = Pixel()
    norm = wp.length(p)
    if not (-p[2] > _MIN_DEPTH * norm):
        return pixel
    q = -1.0 / p[2]
    x = p[0] * q
    y = -p[1] * q
    dx = wp.vec3(q, 0.0, x * q)
    dy = wp.vec3(0.0, -q, y * q)
    if model == 1:
        q = 1.0 / norm
        x = p[0] * q
        y = -p[1] * q
        dx = wp.vec3(q, 0.0, 0.0) - (x * q * q) * p
        dy = wp.vec3(0.0, -q, 0.0) - (y * q * q) * p
    if distorted != 0:
        k1, k2, p1, p2 = params[4], params[5], params[6], params[7]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * k2)
        slope = 2.0 * k1 + 4.0 * k2 * r2
        a = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
        b = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
        d = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
        if not (a * d > b * b and a > 0.0):  # beyond where the polynomial folds back
            return pixel
        xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        y = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        x = xd
        along_x = a * dx + b * dy
        dy = b * dx + d * dy
        dx = along_x
    pixel.lit = 1
    pixel.uv = wp.vec2(params[0] * x + params[2], params[1] * y + params[3])
    pixel.du = params[0] * dx
    pixel.dv = params[1] * dy
    return pixel


@part
def unproject(params: wp.array(dtype=wp.float32), model: wp.int32, distorted: wp.int32, uv: wp.vec2):
    """Unit direction, in the device's axes, of a pixel; not a number where the model has none."""
    xd = (uv[0] - params[2]) / params[0]
    yd = (uv[1] - params[3]) / params[1]
    x = wp.float32(xd)
    y = wp.float32(yd)
    if distorted != 0:
        k1, k2, p1, p2 = params[4], params[5], params[6], params[7]
        for _ in range(12):
            r2 = x * x + y * y
            radial = 1.0 + r2 * (k1 + r2 * k2)
            slope = 2.0 * k1 + 4.0 * k2 * r2
            ex = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) - xd
            ey = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y - yd
            a = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
            b = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
            d = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
            det = a * d - b * b
            if wp.abs(det) < 1.0e-9:
                det = wp.float32(1.0e-9)
            x -= (d * ex - b * ey) / det
            y -= (a * ey - b * ex) / det
    direction = wp.vec3(x, -y, -1.0)
    if model == 1:
        return wp.vec3(x, -y, -wp.sqrt(1.0 - x * x - y * y))
    return direction / wp.length(direction)


@part
def texel(pattern: wp.array2d(dtype=wp.float32), column: wp.int32, row: wp.int32):
    """Intensity of a pixel of the pattern; 0 outside."""
    inside = column >= 0 and row >= 0 and column < pattern.shape[1] and row < pattern.shape[0]
    value = wp.float32(0.0)
    if inside:
        value = pattern[row, column]
    return value


@part
def look_up(pattern: wp.array2d(dtype=wp.float32), uv: wp.vec2):
    """Bilinear intensity at continuous coordinates (first pixel's centre at 0.5), and its two derivatives."""
    x = uv[0] - 0.5
    y = uv[1] - 0.5
    found = wp.vec3()
    if x > -1.0 and y > -1.0 and x < wp.float32(pattern.shape[1]) and y < wp.float32(pattern.shape[0]):
        column = wp.int32(wp.floor(x))
        row = wp.int32(wp.floor(y))
        s = x - wp.float32(column)
        t = y - wp.float32(row)
        a = texel(pattern, column, row)
        b = texel(pattern, column + 1, row)
        c = texel(pattern, column, row + 1)
        d = texel(pattern, column + 1, row + 1)
        top = a + s * (b - a)
        bottom = c + s * (d - c)
        found = wp.vec3(top + t * (bottom - top), (1.0 - t) * (b - a) + t * (d - c), bottom - top)
    return found
