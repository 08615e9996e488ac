"""Sampson's residual of a relative pose, and increments of the pose.

The residual is the distance, to first order, of a decoded coordinate from the epipolar curve of its camera pixel, in
projector pixels. Only the projector's side has an error, because camera pixels are exact centres. It is computed from
rays alone and therefore holds for pinhole, distorted and diffractive projectors.

Five unknowns (w, b): `R <- exp(w) R` rotates the projector about its own centre, in camera axes, and
`t <- exp(B b) t` rotates the unit baseline, where B = `direction_basis(t)` spans the plane perpendicular to it.
"""

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from sl_nerfstudio.compiled import compiled
from sl_nerfstudio.relative_pose.ray_pairs import RayPairs


def direction_basis(t: Float64[ndarray, "3"]) -> Float64[ndarray, "3 2"]:
    """Two unit vectors perpendicular to `t` and to each other, the same ones for the same `t`."""
    B = np.empty((3, 2))
    _basis(t, B)
    return B


def moved(
    R: Float64[ndarray, "3 3"], t: Float64[ndarray, "3"], step: Float64[ndarray, "5"]
) -> tuple[Float64[ndarray, "3 3"], Float64[ndarray, "3"]]:
    """The pose after an increment (w, b)."""
    R_moved, t_moved = np.empty((3, 3)), np.empty(3)
    _move(R, t, step, R_moved, t_moved)
    return R_moved, t_moved


def sampson(R: Float64[ndarray, "3 3"], t: Float64[ndarray, "3"], rays: RayPairs) -> Float64[ndarray, "n"]:
    """Signed distances of the coordinates from their epipolar curves, in projector pixels."""
    return sampson_of_frames(R[None], t[None], rays, np.zeros(len(rays), dtype=np.int64))


def sampson_of_frames(
    R: Float64[ndarray, "frames 3 3"], t: Float64[ndarray, "frames 3"], rays: RayPairs, frame: Int64[ndarray, "n"]
) -> Float64[ndarray, "n"]:
    """The same of rays in several frames, each with a pose of its own."""
    r = np.empty(len(rays))
    _residuals(np.ascontiguousarray(R), t, frame, rays.d_camera, rays.d_projector, rays.d_projector_by_uv, r)
    return r


def sampson_jacobian(
    R: Float64[ndarray, "3 3"], t: Float64[ndarray, "3"], rays: RayPairs
) -> tuple[Float64[ndarray, "n"], Float64[ndarray, "n 5"]]:
    """Residuals and their derivatives by (w, b).

    For a vector q in projector axes, q . m changes with w by R q x n and with b by (R q x d) A, where m is the normal n
    in projector axes and A = t x B = (B2, -B1). The residual a / g has two such products: a, and each part of h, of
    which g is the length; so its change is that of one vector p.
    """
    r, J = np.empty(len(rays)), np.empty((len(rays), 5))
    A = direction_basis(t)[:, ::-1] * [1, -1]
    _derivatives(np.ascontiguousarray(R), t, A, rays.d_camera, rays.d_projector, rays.d_projector_by_uv, r, J)
    return r, J


@compiled
def _basis(t, B):
    x, y, z = t[0], t[1], t[2]
    u, v, w = abs(x), abs(y), abs(z)
    if u <= v and u <= w:  # of the axes, that which is most nearly perpendicular to t
        a, b, c = 0.0, z, -y
    elif v <= w:
        a, b, c = -z, 0.0, x
    else:
        a, b, c = y, -x, 0.0
    inverse = 1 / np.sqrt(a * a + b * b + c * c)
    a, b, c = a * inverse, b * inverse, c * inverse
    B[0, 0], B[1, 0], B[2, 0] = a, b, c
    B[0, 1], B[1, 1], B[2, 1] = y * c - z * b, z * a - x * c, x * b - y * a


@compiled
def _turned(x, y, z, u, v, w):
    """The vector (u, v, w) rotated by a rotation vector (Rodrigues' formula)."""
    square = x * x + y * y + z * z
    angle = np.sqrt(square)
    sine = np.sin(angle) / angle if angle > 1e-8 else 1.0
    half = np.sin(angle / 2) / angle if angle > 1e-8 else 0.5
    a, b, c = y * w - z * v, z * u - x * w, x * v - y * u
    k = 2 * half * half
    return (
        u + sine * a + k * (y * c - z * b), v + sine * b + k * (z * a - x * c), w + sine * c + k * (x * b - y * a)
    )  # fmt: skip


@compiled
def _move(R, t, step, R_moved, t_moved):
    B = np.empty((3, 2))
    _basis(t, B)
    u, v, w = step[0], step[1], step[2]
    for k in range(3):
        R_moved[0, k], R_moved[1, k], R_moved[2, k] = _turned(u, v, w, R[0, k], R[1, k], R[2, k])
    p, q = step[3], step[4]
    x, y, z = B[0, 0] * p + B[0, 1] * q, B[1, 0] * p + B[1, 1] * q, B[2, 0] * p + B[2, 1] * q
    x, y, z = _turned(x, y, z, t[0], t[1], t[2])
    inverse = 1 / np.sqrt(x * x + y * y + z * z)
    t_moved[0], t_moved[1], t_moved[2] = x * inverse, y * inverse, z * inverse


@compiled
def _plane(R, t, d):
    """Normal of the epipolar plane of a camera ray: in camera axes, and in those of the projector."""
    nx, ny, nz = t[1] * d[2] - t[2] * d[1], t[2] * d[0] - t[0] * d[2], t[0] * d[1] - t[1] * d[0]
    mx = nx * R[0, 0] + ny * R[1, 0] + nz * R[2, 0]
    my = nx * R[0, 1] + ny * R[1, 1] + nz * R[2, 1]
    mz = nx * R[0, 2] + ny * R[1, 2] + nz * R[2, 2]
    return nx, ny, nz, mx, my, mz


@compiled
def distance_from_curve(mx, my, mz, e, by):
    """Residual of a projector ray `e` whose derivative is `by`; direction of its gradient, and one over its length."""
    a = mx * e[0] + my * e[1] + mz * e[2]
    h = mx * by[0, 0] + my * by[1, 0] + mz * by[2, 0]
    k = mx * by[0, 1] + my * by[1, 1] + mz * by[2, 1]
    inverse = 1 / max(np.sqrt(h * h + k * k), 1e-300)
    return a * inverse, h * inverse, k * inverse, inverse


@compiled
def _residuals(R, t, frame, d_camera, d_projector, by_uv, r):
    for i in range(len(r)):
        _, _, _, mx, my, mz = _plane(R[frame[i]], t[frame[i]], d_camera[i])
        r[i] = distance_from_curve(mx, my, mz, d_projector[i], by_uv[i])[0]


@compiled
def _derivatives(R, t, A, d_camera, d_projector, by_uv, r, J):
    for i in range(len(r)):
        d, e, by = d_camera[i], d_projector[i], by_uv[i]
        nx, ny, nz, mx, my, mz = _plane(R, t, d)
        s, h, k, inverse = distance_from_curve(mx, my, mz, e, by)
        r[i] = s
        u = (e[0] - s * (by[0, 0] * h + by[0, 1] * k)) * inverse
        v = (e[1] - s * (by[1, 0] * h + by[1, 1] * k)) * inverse
        w = (e[2] - s * (by[2, 0] * h + by[2, 1] * k)) * inverse
        x = R[0, 0] * u + R[0, 1] * v + R[0, 2] * w
        y = R[1, 0] * u + R[1, 1] * v + R[1, 2] * w
        z = R[2, 0] * u + R[2, 1] * v + R[2, 2] * w
        J[i, 0], J[i, 1], J[i, 2] = y * nz - z * ny, z * nx - x * nz, x * ny - y * nx
        p, q, o = y * d[2] - z * d[1], z * d[0] - x * d[2], x * d[1] - y * d[0]
        J[i, 3] = p * A[0, 0] + q * A[1, 0] + o * A[2, 0]
        J[i, 4] = p * A[0, 1] + q * A[1, 1] + o * A[2, 1]
