"""One point of a surface as one frame sees it, and the derivatives of its residual, in compiled loops.

Formulas and conventions are those of `surface_derivatives`, which wraps these loops for arrays.
"""

import numpy as np

from sl_nerfstudio.compiled import compiled
from sl_nerfstudio.geometry.devices.compiled_view import view_of

# A frame's devices as one row: world to camera and camera to projector (rows of 3 x 4 matrices), the projector's centre
# in camera axes, the parameters and the codes of both models.
CAMERA_POSE, PROJECTOR_POSE, CENTRE, CAMERA, PROJECTOR, CODES, DEVICES = 0, 12, 24, 27, 35, 43, 45
# What is known of one point, as one row.
P_CAMERA, BY_POINT, UV_CAMERA, UV_PROJECTOR, SLOPE, BY_PIXEL, AREA, ANGLE, VIEW = 0, 3, 9, 11, 13, 15, 19, 20, 21


@compiled
def moved(T, first, x, y, z):
    """A point moved by the 3 x 4 matrix whose numbers begin at `first`."""
    a = T[first] * x + T[first + 1] * y + T[first + 2] * z + T[first + 3]
    b = T[first + 4] * x + T[first + 5] * y + T[first + 6] * z + T[first + 7]
    c = T[first + 8] * x + T[first + 9] * y + T[first + 10] * z + T[first + 11]
    return a, b, c


@compiled
def _turned(T, first, x, y, z):
    a, b, c = moved(T, first, x, y, z)
    return a - T[first + 3], b - T[first + 7], c - T[first + 11]


@compiled
def view_point(devices, point, normal, view):
    """Fill `view` (VIEW,) for a point and its unit normal in the world, seen by `devices` (DEVICES,)."""
    x, y, z = moved(devices, CAMERA_POSE, point[0], point[1], point[2])
    a, b, c = _turned(devices, CAMERA_POSE, normal[0], normal[1], normal[2])
    view[P_CAMERA], view[P_CAMERA + 1], view[P_CAMERA + 2] = x, y, z
    u, v, _, k0, k1, k2, k3, k4, k5 = view_of(devices[CODES], x, y, z, devices[CAMERA:PROJECTOR])
    view[UV_CAMERA], view[UV_CAMERA + 1] = u, v
    X, Y, Z = moved(devices, PROJECTOR_POSE, x, y, z)
    u, v, _, j0, j1, j2, j3, j4, j5 = view_of(devices[CODES + 1], X, Y, Z, devices[PROJECTOR:CODES])
    view[UV_PROJECTOR], view[UV_PROJECTOR + 1] = u, v
    R = devices[PROJECTOR_POSE:CENTRE]
    for k in range(3):
        view[BY_POINT + k] = j0 * R[k] + j1 * R[4 + k] + j2 * R[8 + k]
        view[BY_POINT + 3 + k] = j3 * R[k] + j4 * R[4 + k] + j5 * R[8 + k]
    p0, p1, p2, q0, q1, q2 = view[BY_POINT:UV_CAMERA]
    facing = x * a + y * b + z * c
    view[SLOPE] = (p0 * x + p1 * y + p2 * z) / facing
    view[SLOPE + 1] = (q0 * x + q1 * y + q2 * z) / facing
    # Columns of the inverse of the rows (k0 k1 k2), (k3 k4 k5), (a b c): motions along the surface by one pixel.
    e0, e1, e2 = k4 * c - k5 * b, k5 * a - k3 * c, k3 * b - k4 * a
    f0, f1, f2 = b * k2 - c * k1, c * k0 - a * k2, a * k1 - b * k0
    area = k0 * e0 + k1 * e1 + k2 * e2
    view[BY_PIXEL], view[BY_PIXEL + 1] = (p0 * e0 + p1 * e1 + p2 * e2) / area, (p0 * f0 + p1 * f1 + p2 * f2) / area
    view[BY_PIXEL + 2], view[BY_PIXEL + 3] = (q0 * e0 + q1 * e1 + q2 * e2) / area, (q0 * f0 + q1 * f1 + q2 * f2) / area
    view[AREA] = abs(area)
    bx, by, bz = x - devices[CENTRE], y - devices[CENTRE + 1], z - devices[CENTRE + 2]
    lengths = ((x * x + y * y + z * z) * (bx * bx + by * by + bz * bz)) ** 0.5
    view[ANGLE] = np.arccos(min(max((x * bx + y * by + z * bz) / lengths, -1.0), 1.0))


@compiled
def derive_residual(devices, point, normal, view, by):
    """Fill `by` (2, 18): derivatives of the residual by delta and rho of the frame, then by the intrinsics."""
    x, y, z = view[P_CAMERA:BY_POINT]
    # A frame that moves carries along what it measured: only the motion across the surface changes the residual.
    turn0 = point[1] * normal[2] - point[2] * normal[1]
    turn1 = point[2] * normal[0] - point[0] * normal[2]
    turn2 = point[0] * normal[1] - point[1] * normal[0]
    camera, projector = devices[CAMERA:PROJECTOR], devices[PROJECTOR:CODES]
    du, dv = view[UV_CAMERA] - camera[2], view[UV_CAMERA + 1] - camera[3]
    for i in range(2):
        slope = view[SLOPE + i]
        by[i, 0], by[i, 1], by[i, 2] = -slope * normal[0], -slope * normal[1], -slope * normal[2]
        by[i, 3], by[i, 4], by[i, 5] = -slope * turn0, -slope * turn1, -slope * turn2
        b0, b1, b2 = view[BY_POINT + 3 * i], view[BY_POINT + 3 * i + 1], view[BY_POINT + 3 * i + 2]
        by[i, 6], by[i, 7], by[i, 8] = -b0, -b1, -b2
        by[i, 9], by[i, 10], by[i, 11] = b1 * z - b2 * y, b2 * x - b0 * z, b0 * y - b1 * x
        across, down = view[BY_PIXEL + 2 * i], view[BY_PIXEL + 2 * i + 1]
        by[i, 12] = -across * du - down * dv
        by[i, 13], by[i, 14] = -across * camera[0], -down * camera[0]
        by[i, 15] = view[UV_PROJECTOR + i] - projector[2 + i]
        by[i, 16], by[i, 17] = projector[0] * (i == 0), projector[0] * (i == 1)


@compiled
def write_rows(confirmed, devices, points, normals, out):
    """Fill `out` (v, 12 frames + 6), which must be zero: by delta of some frames, their rho, and the intrinsics.

    `confirmed` (v, frames) says which of those frames confirm which vertices. A vertex moves by minus the weighted mean
    of its frames' pulls, each the product of a residual's slope and derivatives.
    """
    view, by, frames = np.empty(VIEW), np.empty((2, 18)), len(devices)
    for v in range(len(points)):
        total = 0.0
        for k in range(frames):
            if not confirmed[v, k]:
                continue
            view_point(devices[k], points[v], normals[v], view)
            derive_residual(devices[k], points[v], normals[v], view, by)
            s, t, w = view[SLOPE], view[SLOPE + 1], view[AREA]
            total += w * (s * s + t * t)
            for i in range(6):
                out[v, 6 * k + i] -= w * (s * by[0, i] + t * by[1, i])
                out[v, 6 * (frames + k) + i] -= w * (s * by[0, 6 + i] + t * by[1, 6 + i])
                out[v, 12 * frames + i] -= w * (s * by[0, 12 + i] + t * by[1, 12 + i])
        for i in range(out.shape[1]):
            out[v, i] /= total
