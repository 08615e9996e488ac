"""Pixels of single points with their derivatives, and rays of single pixels, for compiled loops."""

import math

from sl_nerfstudio.compiled import compiled
from sl_nerfstudio.geometry.devices import doe, pinhole
from sl_nerfstudio.geometry.devices.distortion import (
    LEAST_DETERMINANT,
    UNDISTORT_STEPS,
    distort,
    distortion_jacobian,
)

_CONVERGED = 1e-12  # last step of Newton's method, normalised coordinates
_distort, _distortion_jacobian = compiled(distort), compiled(distortion_jacobian)
_pinhole_in_front, _doe_in_front = compiled(pinhole.in_front), compiled(doe.in_front)


@compiled
def view_of(code, x, y, z, parameters):
    """`project` and `project_jacobian` for one point: u, v, whether in front, du by x, y, z, dv by x, y, z.

    `code` is the model's, `parameters` are ordered as PARAMETERS. The derivatives are for points in front.
    """
    r = (x * x + y * y + z * z) ** 0.5
    if code == 0:
        front = _pinhole_in_front(x, y, z)
        q = 1 / max(r, 1e-15) if not front else -1 / z
        xn, yn = x * q, -y * q
        if not front:
            q = -1 / z if z != 0 else 0.0
        ux, uy, uz = q, 0.0, x * q * q
        vx, vy, vz = 0.0, -q, -y * q * q
    else:
        front = _doe_in_front(x, y, z)
        q = 1 / max(r, 1e-15)
        q3 = q * q * q
        xn, yn = x * q, -y * q
        ux, uy, uz = q - x * x * q3, -x * y * q3, -x * z * q3
        vx, vy, vz = x * y * q3, y * y * q3 - q, y * z * q3
    k1, k2, p1, p2 = parameters[4], parameters[5], parameters[6], parameters[7]
    if k1 != 0 or k2 != 0 or p1 != 0 or p2 != 0:
        a, b, d = _distortion_jacobian(xn, yn, k1, k2, p1, p2)
        front = front and a * d > b * b and a > 0
        xn, yn = _distort(xn, yn, k1, k2, p1, p2)
        ux, vx = a * ux + b * vx, b * ux + d * vx
        uy, vy = a * uy + b * vy, b * uy + d * vy
        uz, vz = a * uz + b * vz, b * uz + d * vz
    fx, fy = parameters[0], parameters[1]
    return (
        fx * xn + parameters[2], fy * yn + parameters[3], front,
        fx * ux, fx * uy, fx * uz, fy * vx, fy * vy, fy * vz,
    )  # fmt: skip


@compiled
def ray_of(code, u, v, parameters):
    """`unproject` for one pixel: x, y, z of the unit direction; NaN where the model has none."""
    xd, yd = (u - parameters[2]) / parameters[0], (v - parameters[3]) / parameters[1]
    k1, k2, p1, p2 = parameters[4], parameters[5], parameters[6], parameters[7]
    x, y = xd, yd
    if k1 != 0 or k2 != 0 or p1 != 0 or p2 != 0:
        for _ in range(UNDISTORT_STEPS):
            ex, ey = _distort(x, y, k1, k2, p1, p2)
            ex, ey = ex - xd, ey - yd
            a, b, d = _distortion_jacobian(x, y, k1, k2, p1, p2)
            det = a * d - b * b
            if abs(det) < LEAST_DETERMINANT:
                det = LEAST_DETERMINANT
            dx, dy = (d * ex - b * ey) / det, (a * ey - b * ex) / det
            x, y = x - dx, y - dy
            if abs(dx) + abs(dy) < _CONVERGED:  # the next step would be about the square of it
                break
    if code == 0:
        q = 1 / (x * x + y * y + 1) ** 0.5
        return x * q, -y * q, -q
    square = 1 - x * x - y * y
    return x, -y, -(square**0.5) if square >= 0 else math.nan
