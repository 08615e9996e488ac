"""First solutions for the pose of a projector relative to its camera, by five-point samples.

Random samples are solved (Nister, PAMI 2004, as in OpenCV) and scored. Samples and scores use rays, so every projector
model is treated alike: what OpenCV takes for image points are rays divided by their last component.
"""

from collections.abc import Iterable

import cv2
import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from sl_nerfstudio.relative_pose.epipolar_fit import distinct
from sl_nerfstudio.relative_pose.ray_pairs import RayPairs, subsample
from sl_nerfstudio.relative_pose.sampson import cross
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
    d_p = rays.d_projector @ R.T
    normal = cross(rays.d_camera, d_p)
    camera = (cross(np.broadcast_to(t, d_p.shape), d_p) * normal).sum(-1)
    projector = (cross(np.broadcast_to(t, d_p.shape), rays.d_camera) * normal).sum(-1)
    return (camera > 0) & (projector > 0)


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
    m = np.einsum("ni,kij->knj", rays.d_camera, E)
    a = np.einsum("knj,nj->kn", m, rays.d_projector)
    h = np.einsum("knj,njc->knc", m, rays.d_projector_by_uv)
    return np.minimum(a * a / (h * h).sum(-1).clip(1e-300) / outlier_px**2, 1.0).mean(-1)


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
