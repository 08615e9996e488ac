"""Similarities between a scan and the truth that a few wrong frames do not move."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy import ndarray


@dataclass(frozen=True)
class Similarity:
    """Maps p to s R p + t."""

    s: float
    R: ndarray
    t: ndarray

    def points(self, p: ndarray) -> ndarray:
        """Of points (n, 3)."""
        return self.s * p @ self.R.T + self.t

    def pose(self, T: ndarray) -> ndarray:
        """A rigid pose (4, 4), moved; its rotation stays one."""
        moved = np.eye(4)
        moved[:3, :3], moved[:3, 3] = self.R @ T[:3, :3], self.points(T[None, :3, 3])[0]
        return moved


def angle_deg(R: ndarray) -> float:
    """Angle of a rotation (3, 3); exact near 0 and near 180 degrees."""
    sine = np.linalg.norm([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
    return float(np.degrees(np.arctan2(sine, (np.trace(R) - 1) / 2)))


def nearest_rotation(M: ndarray) -> ndarray:
    """By singular values."""
    U, _, V = np.linalg.svd(M)
    return U @ np.diag([1, 1, np.linalg.det(U @ V)]) @ V


def fitted(p: ndarray, q: ndarray, weights: ndarray) -> Similarity:
    """Weighted least squares (Umeyama) from points p (n, 3) to q."""
    w = weights / weights.sum()
    mp, mq = w @ p, w @ q
    R = nearest_rotation((q - mq).T @ (w[:, None] * (p - mp)))
    s = float(np.sum(w[:, None] * (q - mq) * ((p - mp) @ R.T)) / (w @ ((p - mp) ** 2).sum(1)))
    return Similarity(s, R, mq - s * R @ mp)


def by_cameras(found: Sequence[ndarray], true: Sequence[ndarray]) -> Similarity:
    """From camera poses: rotation, scale by distances of pairs, and shift are medians."""
    turns = [T[:3, :3] @ F[:3, :3].T for F, T in zip(found, true, strict=True)]
    off = [float(np.median([angle_deg(a.T @ b) for b in turns])) for a in turns]
    R = turns[int(np.argmin(off))]
    for _ in range(30):
        weights = [1 / max(angle_deg(R.T @ turn), 1e-3) for turn in turns]
        R = nearest_rotation(np.sum([w * turn for w, turn in zip(weights, turns, strict=True)], axis=0))
    p, q = np.array([R @ F[:3, 3] for F in found]), np.array([T[:3, 3] for T in true])
    i, k = np.triu_indices(len(p), 1)
    s = float(np.median(np.linalg.norm(q[i] - q[k], axis=1) / np.linalg.norm(p[i] - p[k], axis=1)))
    t = np.median(q - s * p, axis=0)
    for _ in range(60):
        w = 1 / np.maximum(np.linalg.norm(s * p + t - q, axis=1), 1e-9)
        t = w @ (q - s * p) / w.sum()
    return Similarity(s, R, t)


def by_points(found: Sequence[ndarray], true: Sequence[ndarray], right: float) -> Similarity:
    """From points that belong together (one array for each frame): with which most frames are closer than `right`.

    Each frame and some pairs propose; then frames that are right count by the inverse of how far they are off.
    """
    n = len(found)
    groups = [[k] for k in range(n)] + [[k, (k + g) % n] for g in (1, 3, n // 2) for k in range(n)]
    best, chosen = (-1, 0.0), fitted(found[0], true[0], np.ones(len(found[0])))
    for group in groups:
        S = _together(group, found, true, np.ones(n))
        off = np.array([_median_distance(S, found[k], true[k]) for k in range(n)])
        near = off[off < right]
        score = len(near), -float(np.median(near)) if len(near) else 0.0
        if score > best:
            best, chosen = score, S
    for _ in range(15):
        off = np.array([_median_distance(chosen, found[k], true[k]) for k in range(n)])
        near = np.nonzero(off < right)[0].tolist()
        chosen = _together(near, found, true, 1 / np.maximum(off, 1e-4 * right)) if near else chosen
    return chosen


def _together(group: Sequence[int], found: Sequence[ndarray], true: Sequence[ndarray], counts: ndarray) -> Similarity:
    weights = np.concatenate([np.full(len(found[k]), counts[k] / len(found[k])) for k in group])
    return fitted(np.concatenate([found[k] for k in group]), np.concatenate([true[k] for k in group]), weights)


def _median_distance(S: Similarity, p: ndarray, q: ndarray) -> float:
    return float(np.median(np.linalg.norm(S.points(p) - q, axis=1)))
