"""Rigid motions SE(3) as 4x4 matrices, accurate at small angles as well.

A pose `T_a_b` maps points of frame b to frame a: `p_a = transform(T_a_b, p_b)`.
Tangent vectors are ordered `(v, w)`: translation first, then rotation (radian).
Every function accepts any leading batch shape.
"""

from collections.abc import Sequence
from math import factorial

import torch
from jaxtyping import Float
from torch import Tensor

from sl_nerfstudio.geometry.constants import constant

# Below these angles, Taylor series replace quotients that would lose digits, and even more in their derivatives.
# Each row holds the coefficients of one power of t^2.
_SERIES_BELOW = 0.3
_SERIES = [[(-1) ** k / factorial(2 * k + first) for first in (1, 2, 3)] for k in range(6)]
_EYE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_LOG_SERIES_BELOW = 0.3
_LOG_SERIES = [[1 / 12], [1 / 720], [1 / 30240], [1 / 1209600], [1 / 47900160], [691 / 1307674368000]]


def hat(w: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Skew-symmetric matrix of `w`: `hat(w) @ p = w x p`."""
    x, y, z = w.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1).reshape(*w.shape[:-1], 3, 3)


def _so3_coefficients(theta2: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """sin(t)/t, (1 - cos(t))/t^2 and (t - sin(t))/t^3 of t = sqrt(theta2), smooth at 0."""
    small = theta2 < _SERIES_BELOW**2
    x = theta2.where(small, torch.zeros_like(theta2))
    t2 = theta2.where(~small, torch.ones_like(theta2))
    t = t2.sqrt()
    half = (t / 2).sin() / t
    a, b, c = _polynomials(x, _SERIES).unbind(-1)
    return (
        torch.where(small, a, t.sin() / t),
        torch.where(small, b, 2 * half * half),
        torch.where(small, c, (t - t.sin()) / (t2 * t)),
    )


def _polynomials(x: Tensor, coefficients: Sequence[Sequence[float]]) -> Tensor:
    """The sums over k of coefficients[k][j] x^k in the last dimension j, by Horner's scheme."""
    *others, last = (constant(tuple(row), x.dtype, x.device) for row in coefficients)
    out = last.expand(*x.shape, -1)
    for row in reversed(others):
        out = out * x[..., None] + row
    return out


def exp_so3(w: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation by |w| radian about w (Rodrigues)."""
    a, b, _ = _so3_coefficients((w * w).sum(-1))
    W = hat(w)
    eye = constant(_EYE, w.dtype, w.device)
    return eye + a[..., None, None] * W + b[..., None, None] * (W @ W)


def log_so3(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Rotation vector of `R`, with an angle in [0, pi]; via the unit quaternion, which is accurate near 0 and pi."""
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = R.flatten(-2).unbind(-1)
    x, y, z = m21 - m12, m02 - m20, m10 - m01
    xy, xz, yz = m10 + m01, m02 + m20, m21 + m12
    one_m00, one_less_m00 = 1 + m00, 1 - m00
    rows = (  # each is 4 q_i * q for one i; the one with the largest q_i is stable
        (one_m00 + m11 + m22, x, y, z),
        (x, one_m00 - m11 - m22, xy, xz),
        (y, xy, one_less_m00 + m11 - m22, yz),
        (z, xz, yz, one_less_m00 - m11 + m22),
    )
    candidates = torch.stack([entry for row in rows for entry in row], -1).unflatten(-1, (4, 4))
    best = torch.diagonal(candidates, dim1=-2, dim2=-1).argmax(-1)
    index = best[..., None, None].expand(*best.shape, 1, 4)
    q = torch.gather(candidates, -2, index).squeeze(-2)
    q = q / q.norm(dim=-1, keepdim=True)
    q = torch.where(q[..., :1] < 0, -q, q)
    real, v = q[..., 0], q[..., 1:]
    s2 = (v * v).sum(-1)
    small = s2 < 1e-10
    s = torch.where(small, torch.ones_like(s2), s2).sqrt()
    # theta / sin(theta / 2) = 2 atan2(s, w) / s -> 2 / w (1 - s^2 / (3 w^2))
    safe = torch.where(small, real, torch.ones_like(real))
    scale = torch.where(small, 2 / safe * (1 - s2 / (3 * safe**2)), 2 * torch.atan2(s, real) / s)
    return scale[..., None] * v


def exp_se3(xi: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 4 4"]:
    """Rigid motion of the twist `xi = (v, w)`."""
    v, w = xi[..., :3], xi[..., 3:]
    a, b, c = _so3_coefficients((w * w).sum(-1))
    W = hat(w)
    W2 = W @ W
    eye = constant(_EYE, xi.dtype, xi.device)
    R = eye + a[..., None, None] * W + b[..., None, None] * W2
    V = eye + b[..., None, None] * W + c[..., None, None] * W2
    return pose(R, (V @ v[..., None]).squeeze(-1))


def log_se3(T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 6"]:
    """Twist `(v, w)` with `exp_se3(twist) = T`; the angle must be below pi."""
    w = log_so3(T[..., :3, :3])
    theta2 = (w * w).sum(-1)
    a, b, _ = _so3_coefficients(theta2)
    small = theta2 < _LOG_SERIES_BELOW**2
    x = theta2.where(small, torch.zeros_like(theta2))
    safe = theta2.where(~small, torch.ones_like(theta2))
    coefficient = torch.where(small, _polynomials(x, _LOG_SERIES)[..., 0], (1 - a / (2 * b)) / safe)
    W = hat(w)
    eye = constant(_EYE, T.dtype, T.device)
    V_inverse = eye - 0.5 * W + coefficient[..., None, None] * (W @ W)
    return torch.cat([(V_inverse @ T[..., :3, 3:]).squeeze(-1), w], -1)


def pose(R: Float[Tensor, "*batch 3 3"], t: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4 4"]:
    """The 4x4 matrix with rotation `R` and translation `t`."""
    top = torch.cat([R, t[..., None]], -1)
    bottom = constant((0.0, 0.0, 0.0, 1.0), top.dtype, top.device).expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, bottom], -2)


def inverse(T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """Inverse of a rigid motion, without inverting a general matrix."""
    R_t = T[..., :3, :3].transpose(-1, -2)
    return pose(R_t, -(R_t @ T[..., :3, 3:]).squeeze(-1))


def adjoint(T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 6 6"]:
    """`exp(adjoint(T) xi) = T exp(xi) inverse(T)`, for xi = (translation, rotation)."""
    R, t = T[..., :3, :3], T[..., :3, 3]
    upper = torch.cat([R, hat(t) @ R], -1)
    return torch.cat([upper, torch.cat([torch.zeros_like(R), R], -1)], -2)


def transform(T: Float[Tensor, "*#batch 4 4"], p: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch 3"]:
    """Points `p` of frame b in frame a, given `T_a_b`; batch shapes broadcast."""
    return rotate(T, p) + T[..., :3, 3]


def rotate(T: Float[Tensor, "*#batch 4 4"], d: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch 3"]:
    """Direction `d` rotated by the rotation of `T`; batch shapes broadcast."""
    R = T[..., :3, :3]
    # products with the three columns: on long batches several times faster than a batched 3x3 product
    return R[..., 0] * d[..., :1] + R[..., 1] * d[..., 1:2] + R[..., 2] * d[..., 2:]
