"""Increments of many poses at once: what `geometry.se3` does with tensors, without the cost of forty small operations.

Poses are 4x4 matrices. An increment (v, w) moves by the exponential of its twist, before the pose.
"""

from math import atan2, sin, sqrt

from sl_nerfstudio.compiled import compiled, compiled_range

_SERIES_BELOW = 0.3  # radian
_TERMS = 8


@compiled
def _coefficients(theta2):
    """sin(t)/t, (1 - cos(t))/t^2 and (t - sin(t))/t^3 of t = sqrt(theta2)."""
    if theta2 < _SERIES_BELOW**2:
        a, b, c = 1.0, 0.5, 1.0 / 6.0
        term_a, term_b, term_c = a, b, c
        for k in range(1, _TERMS):
            term_a *= -theta2 / ((2 * k) * (2 * k + 1))
            term_b *= -theta2 / ((2 * k + 1) * (2 * k + 2))
            term_c *= -theta2 / ((2 * k + 2) * (2 * k + 3))
            a, b, c = a + term_a, b + term_b, c + term_c
        return a, b, c
    t = sqrt(theta2)
    half = sin(t / 2) / t
    return sin(t) / t, 2 * half * half, (t - sin(t)) / (theta2 * t)


@compiled
def _inverse_coefficient(theta2):
    """(1 - a / (2 b)) / t^2 with a and b as above: the inverse of the left Jacobian is I - W / 2 + this W^2."""
    if theta2 < _SERIES_BELOW**2:
        return 1 / 12 + theta2 * (
            1 / 720 + theta2 * (1 / 30240 + theta2 * (1 / 1209600 + theta2 * (1 / 47900160 + theta2 * 5.284e-10)))
        )
    a, b, _ = _coefficients(theta2)
    return (1 - a / (2 * b)) / theta2


@compiled
def _with_two_products(w, v, first, second):
    """v + first (w x v) + second (w x (w x v))."""
    x, y, z = w
    a, b, c = y * v[2] - z * v[1], z * v[0] - x * v[2], x * v[1] - y * v[0]
    d, e, f = y * c - z * b, z * a - x * c, x * b - y * a
    return v[0] + first * a + second * d, v[1] + first * b + second * e, v[2] + first * c + second * f


@compiled
def _rotation_vector(A, B):
    """Of A B^T, for two rotations (or poses); by its unit quaternion, which is accurate near 0 and pi."""
    m = [0.0] * 9
    for i in range(3):
        for j in range(3):
            m[3 * i + j] = A[i, 0] * B[j, 0] + A[i, 1] * B[j, 1] + A[i, 2] * B[j, 2]
    p, q, r = m[7] - m[5], m[2] - m[6], m[3] - m[1]
    largest = max(m[0] + m[4] + m[8], m[0], m[4], m[8])
    if largest == m[0] + m[4] + m[8]:
        real, x, y, z = 1 + largest, p, q, r
    elif largest == m[0]:
        real, x, y, z = p, 1 + m[0] - m[4] - m[8], m[1] + m[3], m[2] + m[6]
    elif largest == m[4]:
        real, x, y, z = q, m[1] + m[3], 1 - m[0] + m[4] - m[8], m[5] + m[7]
    else:
        real, x, y, z = r, m[2] + m[6], m[5] + m[7], 1 - m[0] - m[4] + m[8]
    if real < 0:
        real, x, y, z = -real, -x, -y, -z
    size = sqrt(x * x + y * y + z * z)
    scale = 2 * atan2(size, real) / size if size > 1e-9 * real else 2 / real
    return scale * x, scale * y, scale * z


@compiled_range
def moved_poses(first, last, T, twist, out):
    """Poses after increments."""
    for k in range(first, last):
        w = (twist[k, 3], twist[k, 4], twist[k, 5])
        a, b, c = _coefficients(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
        shift = _with_two_products(w, (twist[k, 0], twist[k, 1], twist[k, 2]), b, c)
        for j in range(4):
            turned = _with_two_products(w, (T[k, 0, j], T[k, 1, j], T[k, 2, j]), a, b)
            for i in range(3):
                out[k, i, j] = turned[i]
            out[k, 3, j] = T[k, 3, j]
        for i in range(3):
            out[k, i, 3] += shift[i]


@compiled_range
def inverse_poses(first, last, T, out):
    """Inverses of rigid motions."""
    for k in range(first, last):
        for i in range(3):
            for j in range(3):
                out[k, i, j] = T[k, j, i]
            out[k, i, 3] = -(T[k, 0, i] * T[k, 0, 3] + T[k, 1, i] * T[k, 1, 3] + T[k, 2, i] * T[k, 2, 3])
            out[k, 3, i] = 0.0
        out[k, 3, 3] = 1.0


@compiled_range
def departures(first, last, camera_then, camera_now, relative_then, relative_now, out):
    """Increment from each camera's pose to its current one; shift and rotation vector of its projector's."""
    for k in range(first, last):
        then, now = camera_then[k], camera_now[k]
        w = _rotation_vector(now, then)
        theta2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
        a, b, _ = _coefficients(theta2)
        turned = _with_two_products(w, (then[0, 3], then[1, 3], then[2, 3]), a, b)
        moved = (now[0, 3] - turned[0], now[1, 3] - turned[1], now[2, 3] - turned[2])
        v = _with_two_products(w, moved, -0.5, _inverse_coefficient(theta2))
        turn = _rotation_vector(relative_now[k], relative_then[k])
        for i in range(3):
            out[k, i], out[k, 3 + i] = v[i], w[i]
            out[k, 6 + i], out[k, 9 + i] = relative_now[k, i, 3] - relative_then[k, i, 3], turn[i]
