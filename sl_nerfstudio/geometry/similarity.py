"""Similarities Sim(3) (uniform scale, rotation, translation) and their least-squares fit."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation


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
        """The same map as a 4x4 matrix, for homogeneous coordinates."""
        out = np.eye(4)
        out[:3, :3] = self.scale * self.R
        out[:3, 3] = self.t
        return out


def angle_deg(R: Float[ndarray, "3 3"]) -> float:
    """Angle of a rotation, in degrees."""
    return float(np.degrees(Rotation.from_matrix(R).magnitude()))


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
