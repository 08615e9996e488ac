"""First solutions for the pose of a projector relative to its camera, by five-point samples.

Random samples are solved (Nister, PAMI 2004, as in OpenCV) and scored. Samples and scores use rays, so every projector
model is treated alike: what OpenCV takes for image points are rays divided by their last component.
"""

from collections.abc import Iterable

import cv2
import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from sl_nerfstudio.compiled import compiled, compiled_sums
from sl_nerfstudio.relative_pose.epipolar_fit import distinct
from sl_nerfstudio.relative_pose.ray_pairs import RayPairs, subsample
from sl_nerfstudio.relative_pose.sampson import distance_from_curve
from sl_nerfstudio.relative_pose.settings import RELATIVE_POSE_DEFAULTS, RelativePoseSettings, Separation


def five_point_starts(
    rays: RayPairs, rng: np.random.Generator, settings: RelativePoseSettings = RELATIVE_POSE_DEFAULTS
) -> list[tuple[Float64[ndarray, "3 3"], Float64[ndarray, "3"]]]:
    """Poses (R, t), projector to camera, |t| = 1, of the best samples, without those close to a better one."""
    s = settings.five_point
    usable = (rays.d_camera[:, 2] < -s.least_cosine) & (rays.d_projector[:, 2] < -s.least_cosine)
    candidates = np.flatnonzero(usable)
    if len(candidates) < 5:
        return []
    scoring_rays = rays.chosen(subsample(candidates, s.scoring_rays, rng))
    samples = [rays.chosen(rng.choice(candidates, 5, replace=False)) for _ in range(s.samples)]
    matrices = [(E, sample) for sample in samples for E in essential_matrices(sample)]
    if not matrices:
        return []
    scores = _scores(np.stack([E for E, _ in matrices]), scoring_rays, s.outlier_px)
    return _distinct_starts([matrices[k] for k in np.argsort(scores)], s.starts, s.separation)


def in_front(R: Float64[ndarray, "3 3"], t: Float64[ndarray, "3"], rays: RayPairs) -> Bool[ndarray, "n"]:
    """Whether the two rays of each pair are nearest to each other in front of both devices."""
    front = np.empty(len(rays), dtype=np.bool_)
    _in_front(np.ascontiguousarray(R), t, rays.d_camera, rays.d_projector, front)
    return front


def essential_matrices(sample: RayPairs) -> list[Float64[ndarray, "3 3"]]:
    """All essential matrices `d_camera^T E d_projector = 0` of five pairs; none of a degenerate sample."""
    projector, camera = (d[:, :2] / d[:, 2:] for d in (sample.d_projector, sample.d_camera))
    try:
        stacked, _ = cv2.findEssentialMat(projector, camera, np.eye(3))
    except cv2.error:
        return []
    if stacked is None or not np.isfinite(stacked).all():
        return []
    return [stacked[k : k + 3] for k in range(0, len(stacked) - 2, 3)]


def poses_of(E: Float64[ndarray, "3 3"], sample: RayPairs) -> list[tuple[ndarray, ndarray]]:
    """The poses (R, t) of an essential matrix that have most of the sample in front: usually one of four."""
    R1, R2, t = cv2.decomposeEssentialMat(E)
    poses = [(R, s * t[:, 0] / np.linalg.norm(t)) for R in (R1, R2) for s in (1.0, -1.0)]
    return [(R, t) for R, t in poses if in_front(R, t, sample).sum() >= 4]


def _scores(E: Float64[ndarray, "m 3 3"], rays: RayPairs, outlier_px: float) -> Float64[ndarray, "m"]:
    """Mean of the squared residuals (as `sampson`), each at most 1, for every matrix."""
    scores = np.empty(len(E))
    _score(np.ascontiguousarray(E), rays.d_camera, rays.d_projector, rays.d_projector_by_uv, outlier_px**2, scores)
    return scores


def _distinct_starts(
    ranked: Iterable[tuple[ndarray, RayPairs]], count: int, separation: Separation
) -> list[tuple[ndarray, ndarray]]:
    """Poses of the best matrices, without those that are close to a better one."""
    kept: list[tuple[ndarray, ndarray]] = []
    for E, sample in ranked:
        for R, t in poses_of(E, sample):
            if all(distinct((R, t), other, separation) for other in kept):
                kept.append((R, t))
        if len(kept) >= count:
            break
    return kept


@compiled_sums
def _score(E, d_camera, d_projector, by_uv, limit, scores):
    for k in range(len(E)):
        M, total = E[k], 0.0
        for i in range(len(d_camera)):
            d = d_camera[i]
            x = d[0] * M[0, 0] + d[1] * M[1, 0] + d[2] * M[2, 0]
            y = d[0] * M[0, 1] + d[1] * M[1, 1] + d[2] * M[2, 1]
            z = d[0] * M[0, 2] + d[1] * M[1, 2] + d[2] * M[2, 2]
            total += min(distance_from_curve(x, y, z, d_projector[i], by_uv[i])[0] ** 2 / limit, 1.0)
        scores[k] = total / len(d_camera)


@compiled
def _in_front(R, t, d_camera, d_projector, front):
    """By the signs of the depths along both rays where they are nearest to each other."""
    for i in range(len(front)):
        a, b, c = d_camera[i, 0], d_camera[i, 1], d_camera[i, 2]
        u, v, w = d_projector[i, 0], d_projector[i, 1], d_projector[i, 2]
        x = R[0, 0] * u + R[0, 1] * v + R[0, 2] * w
        y = R[1, 0] * u + R[1, 1] * v + R[1, 2] * w
        z = R[2, 0] * u + R[2, 1] * v + R[2, 2] * w
        p, q, r = b * z - c * y, c * x - a * z, a * y - b * x
        camera = (t[1] * z - t[2] * y) * p + (t[2] * x - t[0] * z) * q + (t[0] * y - t[1] * x) * r
        projector = (t[1] * c - t[2] * b) * p + (t[2] * a - t[0] * c) * q + (t[0] * b - t[1] * a) * r
        front[i] = camera > 0 and projector > 0
