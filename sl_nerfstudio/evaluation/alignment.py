"""Aligning a result with the truth: by its poses, then by its surface (ICP)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from sl_nerfstudio.evaluation.indexed_mesh import IndexedMesh
from sl_nerfstudio.geometry.similarity import Similarity

_MAX_LOG_SCALE = np.log(1.5)  # limit for ICP with scale, which could otherwise shrink the result onto a patch
_TRUSTED = 0.7  # share of the points assumed to lie on the target
_TRUSTED_SIGMA = 1.0364  # quantile of |x| at _TRUSTED, x standard normal
_TUKEY = 4.685  # of the robust sigma: 95 % efficiency on normal residuals (Tukey's biweight)


@dataclass(frozen=True)
class Alignment:
    """A fitted map, and how well it fits."""

    S_target_source: Similarity
    residual: float  # RMS distance of the best 80 % of the points, in the target's unit


def align_poses(
    T_estimated: Float[ndarray, "n 4 4"], T_true: Float[ndarray, "n 4 4"], with_scale: bool = True
) -> Similarity:
    """Least-squares map of estimated onto true device poses, from centres and orientations together.

    The rotation minimises the squared centre errors (relative to the spread of the centres) plus the
    squared chordal distances of the orientations, so that two devices, or centres on one line, are enough.
    Scale and translation then follow from the centres alone.
    """
    source, target = T_estimated[:, :3, 3], T_true[:, :3, 3]
    mean_s, mean_t = source.mean(0), target.mean(0)
    s, t = source - mean_s, target - mean_t
    spread = float(np.sqrt((s * s).sum(1).mean() * (t * t).sum(1).mean()))
    # The true orientation of a device is R @ the estimated one.
    turns = np.einsum("nij,nkj->ik", T_true[:, :3, :3], T_estimated[:, :3, :3]) / len(s)
    centres = t.T @ s / len(s) / spread if spread > 0 else np.zeros((3, 3))
    U, _, Vt = np.linalg.svd(turns + centres)
    R = (U * np.array([1.0, 1.0, np.linalg.det(U @ Vt)])) @ Vt
    moment = float((s * s).sum())
    scale = float((t * (s @ R.T)).sum() / moment) if with_scale and moment > 0 else 1.0
    scale = scale if scale > 0 else 1.0
    return Similarity(scale, R, mean_t - scale * R @ mean_s)


def icp(
    points: Float[ndarray, "n 3"],
    target: IndexedMesh,
    start: Similarity,
    with_scale: bool,
    max_iterations: int = 60,
) -> Alignment:
    """Robust point-to-plane ICP of `points` onto `target`, from `start`.

    Each round matches every point with the nearest point of the target's triangles and takes one
    Gauss-Newton step on the point-to-plane distances, weighted by Tukey's biweight with the sigma of the best
    70 % of the current distances, so surface that the target does not have gets weight zero. (With the best half, a
    plate that fits perfectly would give weight zero to everything on it.)
    Directions that the data do not determine (the rotations of a sphere) stay at their start.
    """
    S = start
    for _ in range(max_iterations):
        moved = S.points(points)
        near = target.closest(moved)
        weights = _tukey(near.distance, floor=1e-9 * target.diagonal)
        step = _gauss_newton_step(moved, near.point, near.normal, weights, with_scale)
        proposed = step @ S
        bounded = float(np.clip(np.log(proposed.scale / start.scale), -_MAX_LOG_SCALE, _MAX_LOG_SCALE))
        S = Similarity(start.scale * float(np.exp(bounded)), proposed.R, proposed.t)
        change = np.abs(S.points(points) - moved).max()
        if change < 1e-5 * target.diagonal:
            break
    final = np.sort(target.distance(S.points(points)))
    best = final[: max(1, int(0.8 * len(final)))]
    return Alignment(S, float(np.sqrt((best**2).mean())))


def _tukey(distance: Float[ndarray, "n"], floor: float) -> Float[ndarray, "n"]:
    cut = max(_TUKEY * float(np.percentile(distance, 100 * _TRUSTED)) / _TRUSTED_SIGMA, floor)
    return np.clip(1 - (distance / cut) ** 2, 0, None) ** 2


def _gauss_newton_step(
    p: Float[ndarray, "n 3"],
    q: Float[ndarray, "n 3"],
    normal: Float[ndarray, "n 3"],
    weights: Float[ndarray, "n"],
    with_scale: bool,
) -> Similarity:
    """The small similarity about the centroid of `p` that moves `p` closest to the planes through `q`."""
    total = weights.sum()
    if total <= 0:
        return Similarity.identity()
    centroid = weights @ p / total
    local = p - centroid
    size = float(np.sqrt(weights @ (local**2).sum(1) / total)) or 1.0
    local = local / size  # columns without units: rotation, translation and scale have equal weight
    columns = [normal, np.cross(local, normal)]
    if with_scale:
        columns.append((local * normal).sum(1, keepdims=True))
    J = np.concatenate(columns, 1)
    r = ((q - p) * normal).sum(1) / size
    H = J.T @ (weights[:, None] * J)
    x = np.linalg.lstsq(H, J.T @ (weights * r), rcond=1e-8)[0]
    R = _rotation(x[3:6])
    scale = float(np.exp(np.clip(x[6], -0.2, 0.2))) if with_scale else 1.0
    return Similarity(scale, R, centroid + size * x[:3] - scale * R @ centroid)


def _rotation(w: Float[ndarray, "3"]) -> Float[ndarray, "3 3"]:
    """Rotation by |w| about w, at most 0.5 rad per step."""
    angle = float(np.linalg.norm(w))
    if angle < 1e-300:
        return np.eye(3)
    x, y, z = w / angle
    angle = min(angle, 0.5)
    W = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * W + (1 - np.cos(angle)) * W @ W
