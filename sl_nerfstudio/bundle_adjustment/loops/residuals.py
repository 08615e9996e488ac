"""Residuals and their derivatives; `bundle_adjustment/residuals.py` says what they are.

`devices` are a rig's arrays (`Rig.arrays`): poses of the cameras in the world, their inverses, those of the
cameras in their projectors, and parameters and model codes of cameras and projector. Arrays for derivatives may be
empty: then none are computed.
"""

import numpy as np

from sl_nerfstudio.compiled import compiled, compiled_range
from sl_nerfstudio.geometry.devices.compiled_view import view_of
from sl_nerfstudio.geometry.rigid import moved, row_times_rotation


@compiled
def _by_increment(out, first, sign, a, b, c, x, y, z):
    """out[first : first + 6] = sign * [b, -b x p]: a derivative by a point p, as one by an increment of its pose."""
    out[first], out[first + 1], out[first + 2] = sign * a, sign * b, sign * c
    out[first + 3] = -sign * (b * z - c * y)
    out[first + 4] = -sign * (c * x - a * z)
    out[first + 5] = -sign * (a * y - b * x)


@compiled
def _world_point(devices, frame, depth, ray):
    """A point along a camera ray."""
    return moved(devices[0][frame], depth * ray[0], depth * ray[1], depth * ray[2])


@compiled_range
def own_residuals(first, last, devices, frame, rays, depths, decoded, residual, by_pose, by_depth):
    """The anchors' own: decoded coordinates from their projector's view of them."""
    _, _, T_projector_camera, _, _, projector, code = devices
    derivatives = len(by_depth) > 0
    for k in range(first, last):
        T, ray = T_projector_camera[frame[k]], rays[k]
        x, y, z = depths[k] * ray[0], depths[k] * ray[1], depths[k] * ray[2]
        u, v, _, ux, uy, uz, vx, vy, vz = view_of(code, *moved(T, x, y, z), projector)
        residual[k, 0], residual[k, 1] = u - decoded[k, 0], v - decoded[k, 1]
        if derivatives:
            for c, row in ((0, (ux, uy, uz)), (1, (vx, vy, vz))):
                a, b, d = row_times_rotation(row[0], row[1], row[2], T)
                _by_increment(by_pose[k, c], np.int64(0), -1.0, a, b, d, x, y, z)
                by_depth[k, c] = a * ray[0] + b * ray[1] + d * ray[2]


@compiled_range
def positions(first, last, devices, frame, rays, depths, anchor, viewer, uv, in_front):
    """Where other cameras see the anchors."""
    _, T_camera_world, _, cameras, code, _, _ = devices
    for k in range(first, last):
        a, j = anchor[k], viewer[k]
        x, y, z = _world_point(devices, frame[a], depths[a], rays[a])
        x, y, z = moved(T_camera_world[j], x, y, z)
        uv[k, 0], uv[k, 1], in_front[k] = view_of(code, x, y, z, cameras[j])[:3]


@compiled_range
def cross_residuals(
    first, last, devices, frame, rays, depths, anchor, viewer, seen, seen_by_pixel, residual, by_pose, by_depth
):
    """What other frames decoded (`seen`, with its derivatives by the pixel), from their projectors' views."""
    T_world_camera, T_camera_world, T_projector_camera, cameras, camera_code, projector, projector_code = devices
    derivatives = len(by_depth) > 0
    for k in range(first, last):
        n, j = anchor[k], viewer[k]
        i, ray = frame[n], rays[n]
        x, y, z = _world_point(devices, i, depths[n], ray)
        xj, yj, zj = moved(T_camera_world[j], x, y, z)
        T = T_projector_camera[j]
        u, v, _, ux, uy, uz, vx, vy, vz = view_of(projector_code, *moved(T, xj, yj, zj), projector)
        residual[k, 0], residual[k, 1] = u - seen[k, 0], v - seen[k, 1]
        if derivatives:
            _, _, _, cux, cuy, cuz, cvx, cvy, cvz = view_of(camera_code, xj, yj, zj, cameras[j])
            R = T_world_camera[i]
            dx = R[0, 0] * ray[0] + R[0, 1] * ray[1] + R[0, 2] * ray[2]
            dy = R[1, 0] * ray[0] + R[1, 1] * ray[1] + R[1, 2] * ray[2]
            dz = R[2, 0] * ray[0] + R[2, 1] * ray[1] + R[2, 2] * ray[2]
            for c, row in ((0, (ux, uy, uz)), (1, (vx, vy, vz))):
                a, b, d = row_times_rotation(row[0], row[1], row[2], T)
                _by_increment(by_pose[k, c], np.int64(12), -1.0, a, b, d, xj, yj, zj)
                du, dv = seen_by_pixel[k, c, 0], seen_by_pixel[k, c, 1]
                a, b, d = a - du * cux - dv * cvx, b - du * cuy - dv * cvy, d - du * cuz - dv * cvz
                a, b, d = row_times_rotation(a, b, d, T_camera_world[j])
                _by_increment(by_pose[k, c], np.int64(0), 1.0, a, b, d, x, y, z)
                _by_increment(by_pose[k, c], np.int64(6), -1.0, a, b, d, x, y, z)
                by_depth[k, c] = a * dx + b * dy + d * dz
