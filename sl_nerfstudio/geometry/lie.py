"""Increments of many poses at once: what `geometry.se3` does with tensors, without the cost of forty small operations.

Poses are 4x4 matrices. An increment (v, w) moves by the exponential of its twist, before the pose.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import permutations, product
from math import atan2, degrees, factorial, hypot, sin, sqrt

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from numpy import ndarray
from scipy.spatial.transform import Rotation
from torch import Tensor

from sl_nerfstudio.parallel import compiled, compiled_range

# Small constant tensors, copied to a device once: a copy from the host's memory makes the host wait for a GPU.

Numbers = tuple[float, ...] | tuple[tuple[float, ...], ...]


@lru_cache(maxsize=256)
def constant(values: Numbers, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The tensor of some numbers; it is shared, so it must not be changed."""
    with torch.inference_mode(False):
        return torch.tensor(values, dtype=dtype, device=device)


# Rigid motions SE(3) as 4x4 matrices, accurate at small angles as well.
#
# A pose `T_a_b` maps points of frame b to frame a: `p_a = transform(T_a_b, p_b)`.
# Tangent vectors are ordered `(v, w)`: translation first, then rotation (radian).
# Every function accepts any leading batch shape.

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


# Similarities Sim(3) (uniform scale, rotation, translation) and their least-squares fit.


@dataclass(frozen=True)
class Similarity:
    """Maps `p_b` to `p_a = scale * R @ p_b + t`. Named `S_a_b`, like poses."""

    scale: float
    R: Float[ndarray, "3 3"]
    t: Float[ndarray, "3"]

    @staticmethod
    def identity() -> "Similarity":
        """The identity."""
        return Similarity.scaling(1.0)

    @staticmethod
    def scaling(factor: float) -> "Similarity":
        """All lengths multiplied by `factor`, about the origin."""
        return Similarity(factor, np.eye(3), np.zeros(3))

    def points(self, p: Float[ndarray, "*batch 3"]) -> Float[ndarray, "*batch 3"]:
        """Points of frame b in frame a."""
        return self.scale * p @ self.R.T + self.t

    def poses(self, T: Float[ndarray, "*batch 4 4"]) -> Float[ndarray, "*batch 4 4"]:
        """Poses `T_b_device` as `T_a_device`: rotations are rotated, positions are mapped; the result is rigid."""
        out = np.array(T, dtype=np.float64)
        out[..., :3, :3] = self.R @ T[..., :3, :3]
        out[..., :3, 3] = self.points(T[..., :3, 3])
        return out

    def inverse(self) -> "Similarity":
        """`S_b_a`."""
        return Similarity(1 / self.scale, self.R.T, -self.R.T @ self.t / self.scale)

    def __matmul__(self, other: "Similarity") -> "Similarity":
        """`S_a_c = S_a_b @ S_b_c`."""
        return Similarity(self.scale * other.scale, self.R @ other.R, self.points(other.t))

    def matrix(self) -> Float[ndarray, "4 4"]:
        """The map as a 4x4 matrix, for homogeneous coordinates."""
        out = np.eye(4)
        out[:3, :3] = self.scale * self.R
        out[:3, 3] = self.t
        return out


AXIS_TURNS: tuple[Float64[ndarray, "3 3"], ...] = tuple(
    R
    for order in permutations(range(3))
    for signs in product((1.0, -1.0), repeat=3)
    if np.linalg.det(R := np.eye(3)[list(order)] * np.array(signs)[:, None]) > 0
)
"""The 24 rotations that exchange axes."""


def axis_words(R: Float64[ndarray, "3 3"]) -> str:
    """The rows of one of them as axes: "x, -z, y"."""
    return ", ".join(("-" if row.sum() < 0 else "") + "xyz"[int(np.abs(row).argmax())] for row in R)


def angle_deg(R: Float[ndarray, "3 3"]) -> float:
    """Angle of a rotation, in degrees; accurate for small and large ones."""
    sine = hypot(R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1])
    return degrees(atan2(sine, R[0, 0] + R[1, 1] + R[2, 2] - 1.0))


def centred_on(points: Float[ndarray, "n 3"], edge_percent: float) -> Similarity:
    """The scaling and shift that put the box around points about the origin, with half its diagonal one.

    `edge_percent` of the points may lie outside the box on each of its sides. Points in one place keep their scale.
    """
    low, high = np.percentile(points, [edge_percent, 100 - edge_percent], axis=0)
    radius = float(np.linalg.norm(high - low) / 2) or 1.0
    return Similarity(1 / radius, np.eye(3), -(low + high) / 2 / radius)


def fit_similarity(
    source: Float[ndarray, "n 3"],
    target: Float[ndarray, "n 3"],
    with_scale: bool = True,
    weights: Float[ndarray, "n"] | None = None,
) -> Similarity:
    """Least-squares similarity that maps `source` onto `target`, point by point (Umeyama, PAMI 1991, eq. 40 to 42).

    Raises ValueError for fewer than three pairs.
    """
    if len(source) < 3 or source.shape != target.shape:
        raise ValueError(f"a similarity needs at least 3 pairs of points, got {source.shape} and {target.shape}")
    w = np.full(len(source), 1.0) if weights is None else weights
    w = w / w.sum()
    mean_s, mean_t = w @ source, w @ target
    s, t = source - mean_s, target - mean_t
    U, D, Vt = np.linalg.svd(t.T @ (w[:, None] * s))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R = (U * sign) @ Vt
    scale = float((D * sign).sum() / (w @ (s * s).sum(1))) if with_scale else 1.0
    return Similarity(scale, R, mean_t - scale * R @ mean_s)


# Many similarities at once, and their increments (v, w, l) about pivots (see `increments`).


@dataclass(frozen=True)
class Similarities:
    """Each maps `p_b` to `scale * R @ p_b + t`."""

    scale: Float64[ndarray, "n"]
    R: Float64[ndarray, "n 3 3"]
    t: Float64[ndarray, "n 3"]

    @staticmethod
    def of(each: Sequence[Similarity]) -> "Similarities":
        """Stack a non-empty sequence."""
        scale, R, t = zip(*((S.scale, S.R, S.t) for S in each), strict=True)
        return Similarities(np.array(scale), np.stack(R), np.stack(t))

    def each(self) -> list[Similarity]:
        """One by one."""
        return [Similarity(float(s), R, t) for s, R, t in zip(self.scale, self.R, self.t, strict=True)]

    def chosen(self, index: Int64[ndarray, "m"]) -> "Similarities":
        """Some of them."""
        return Similarities(self.scale[index], self.R[index], self.t[index])

    def points(self, p: Float64[ndarray, "n 3"]) -> Float64[ndarray, "n 3"]:
        """One point of frame b each in frame a."""
        return self.scale[:, None] * (self.R @ p[..., None])[..., 0] + self.t

    def orthonormal(self) -> "Similarities":
        """Replace each matrix by the nearest rotation.

        `inverse` transposes, and products of similarities and inverses double what is not orthonormal, again and again:
        rounding errors become large where components are joined a hundred times.
        """
        return Similarities(self.scale, Rotation.from_matrix(self.R).as_matrix(), self.t)

    def inverse(self) -> "Similarities":
        """Element-wise inverse."""
        R = self.R.transpose(0, 2, 1)
        return Similarities(1 / self.scale, R, -(R @ self.t[..., None])[..., 0] / self.scale[:, None])

    def __matmul__(self, other: "Similarities") -> "Similarities":
        """Products of pairs."""
        return Similarities(self.scale * other.scale, self.R @ other.R, self.points(other.t))


def logs_at(D: Similarities, centre: Float64[ndarray, "n 3"], radius: Float64[ndarray, "n"]) -> Float64[ndarray, "n 7"]:
    """Increments about pivots that are the similarities."""
    v = (D.points(centre) - centre) / radius[:, None]
    return np.concatenate([v, Rotation.from_matrix(D.R).as_rotvec(), np.log(D.scale)[:, None]], 1)


def exps_at(
    x: Float64[ndarray, "n 7"],
    centre: Float64[ndarray, "n 3"],
    radius: Float64[ndarray, "n"],
    largest_log_scale: float,
) -> Similarities:
    """The similarities of increments about pivots."""
    R = Rotation.from_rotvec(x[:, 3:6]).as_matrix()
    scale = np.exp(np.clip(x[:, 6], -largest_log_scale, largest_log_scale))
    turned = scale[:, None] * (R @ centre[..., None])[..., 0]
    return Similarities(scale, R, centre - turned + radius[:, None] * x[:, :3])


# Rigid motions of single points, for compiled loops.


@compiled
def moved(T, x, y, z):
    """A point under a rigid motion."""
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
    )


@compiled
def rotated(R, x, y, z):
    """A vector under a rotation, or under the rotation of a rigid motion."""
    return (
        R[0, 0] * x + R[0, 1] * y + R[0, 2] * z,
        R[1, 0] * x + R[1, 1] * y + R[1, 2] * z,
        R[2, 0] * x + R[2, 1] * y + R[2, 2] * z,
    )


@compiled
def cross(a, b, c, x, y, z):
    """The cross product of two vectors."""
    return b * z - c * y, c * x - a * z, a * y - b * x


@compiled
def row_times_rotation(a, b, c, T):
    """A row vector times the rotation of a rigid motion."""
    return (
        a * T[0, 0] + b * T[1, 0] + c * T[2, 0],
        a * T[0, 1] + b * T[1, 1] + c * T[2, 1],
        a * T[0, 2] + b * T[1, 2] + c * T[2, 2],
    )


# Poses of the cameras and projectors of all frames.


@dataclass(frozen=True)
class DevicePoses:
    """Camera and projector poses of all frames, device to world; NaN where a frame has none."""

    T_world_camera: Float64[ndarray, "n 4 4"]
    T_world_projector: Float64[ndarray, "n 4 4"]

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.T_world_camera)

    def __getitem__(self, frames: Sequence[int] | slice | ndarray) -> "DevicePoses":
        """The poses of some frames."""
        return DevicePoses(self.T_world_camera[frames], self.T_world_projector[frames])

    @property
    def T_camera_projector(self) -> Float64[ndarray, "n 4 4"]:
        """Pose of each projector in the axes of its camera."""
        return np.linalg.inv(self.T_world_camera) @ self.T_world_projector

    @property
    def baseline(self) -> Float64[ndarray, "n"]:
        """Distance between camera and projector of each frame."""
        return np.linalg.norm(self.T_world_camera[:, :3, 3] - self.T_world_projector[:, :3, 3], axis=1)

    def stacked(self) -> Float64[ndarray, "m 4 4"]:
        """Cameras, then projectors."""
        return np.concatenate([self.T_world_camera, self.T_world_projector])

    def mapped(self, S_target_world: Similarity) -> "DevicePoses":
        """Map the poses to other axes and another unit; orientations stay rotations."""
        return DevicePoses(S_target_world.poses(self.T_world_camera), S_target_world.poses(self.T_world_projector))


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
    """Rotation vector of A B^T, of two rotations (or poses), by its unit quaternion: accurate near 0 and pi."""
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
