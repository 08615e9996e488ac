"""Starting poses of a projector against its camera: five-point solutions of random samples, best ones polished.

Samples and scores use rays, so every projector model is served alike. (Nister's solver, PAMI 2004, as in OpenCV; its
"image points" are rays divided by their last component.)
"""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from sl_nerfstudio.relative_pose.epipolar_fit import EpipolarFit, fit_epipolar
from sl_nerfstudio.relative_pose.ray_pairs import RayPairs

_SAMPLES = 100  # with a third of wrong coordinates all of them meet one with probability 1e-6
_SCORED = 300  # rays by which samples are told apart
_POLISHED = 800  # rays by which the best are refined before they are compared
_KEPT = 6
_POLISHING = 12  # iterations
_TOLERANCE = 4.0  # projector pixels: beyond it a residual counts as wrong while samples are compared
_STEEPEST = 1e-3  # cosine: rays closer than this to the plane of a device cannot be written as image points


@dataclass(frozen=True)
class Candidate:
    """A distinct solution."""

    fit: EpipolarFit
    in_front: float  # fraction of the well-fitting rays that meet in front of both devices


def five_point_candidates(rays: RayPairs, rng: np.random.Generator) -> list[Candidate]:
    """Distinct local optima with most rays meeting in front, the best first; may be empty."""
    usable = (rays.d_camera[:, 2] < -_STEEPEST) & (rays.d_projector[:, 2] < -_STEEPEST)
    candidates = np.flatnonzero(usable)
    if len(candidates) < 5:
        return []
    score_rays = rays.chosen(_some(candidates, _SCORED, rng))
    polish_rays = rays.chosen(_some(np.arange(len(rays)), _POLISHED, rng))
    samples = [rays.chosen(rng.choice(candidates, 5, replace=False)) for _ in range(_SAMPLES)]
    matrices = [(E, sample) for sample in samples for E in _five_point(sample)]
    if not matrices:
        return []
    scores = _scores(np.stack([E for E, _ in matrices]), score_rays)
    starts = _distinct([matrices[k] for k in np.argsort(scores)])
    found: list[Candidate] = []
    for R, t in starts:
        polished = fit_epipolar(R, t, polish_rays, _POLISHING)
        front = float(in_front(polished.R, polished.t, polish_rays)[_fitting(polished)].mean())
        if front < 0.5:  # the same essential matrix, seen the other way round
            continue
        if all(_apart(polished, other.fit) for other in found):
            found.append(Candidate(polished, front))
    return sorted(found, key=lambda c: c.fit.noise_px)


def in_front(R: Float64[ndarray, "3 3"], t: Float64[ndarray, "3"], rays: RayPairs) -> Bool[ndarray, "n"]:
    """Whether the two rays of each pair are nearest to each other in front of both devices."""
    d_p = rays.d_projector @ R.T
    normal = np.cross(rays.d_camera, d_p)
    camera = (np.cross(t, d_p) * normal).sum(-1)
    projector = (np.cross(t, rays.d_camera) * normal).sum(-1)
    return (camera > 0) & (projector > 0)


def _some(index: ndarray, count: int, rng: np.random.Generator) -> ndarray:
    return index if len(index) <= count else rng.choice(index, count, replace=False)


def _five_point(sample: RayPairs) -> list[Float64[ndarray, "3 3"]]:
    """All essential matrices `d_camera^T E d_projector = 0` of five pairs."""
    projector, camera = (d[:, :2] / d[:, 2:] for d in (sample.d_projector, sample.d_camera))
    try:
        stacked, _ = cv2.findEssentialMat(projector, camera, np.eye(3))
    except cv2.error:  # a degenerate sample
        return []
    if stacked is None or not np.isfinite(stacked).all():
        return []
    return [stacked[k : k + 3] for k in range(0, len(stacked) - 2, 3)]


def _decompose(E: Float64[ndarray, "3 3"], sample: RayPairs) -> list[tuple[ndarray, ndarray]]:
    """The poses of an essential matrix that have most of the sample in front: usually one of four."""
    R1, R2, t = cv2.decomposeEssentialMat(E)
    poses = [(R, s * t[:, 0] / np.linalg.norm(t)) for R in (R1, R2) for s in (1.0, -1.0)]
    return [(R, t) for R, t in poses if in_front(R, t, sample).sum() >= 4]


def _scores(E: Float64[ndarray, "m 3 3"], rays: RayPairs) -> Float64[ndarray, "m"]:
    """Mean of the squared residuals (as `sampson`), each at most 1, for every matrix."""
    m = np.einsum("ni,kij->knj", rays.d_camera, E)
    a = np.einsum("knj,nj->kn", m, rays.d_projector)
    h = np.einsum("knj,njc->knc", m, rays.d_projector_by_uv)
    return np.minimum(a * a / (h * h).sum(-1).clip(1e-300) / _TOLERANCE**2, 1.0).mean(-1)


def _distinct(ranked: Iterable[tuple[ndarray, RayPairs]]) -> list[tuple[ndarray, ndarray]]:
    """Poses of the best matrices, without those that are close to a better one."""
    kept: list[tuple[ndarray, ndarray]] = []
    for E, sample in ranked:
        for R, t in _decompose(E, sample):
            if all(_angle(R, k[0]) > 0.05 or _swing(t, k[1]) > 0.1 for k in kept):
                kept.append((R, t))
        if len(kept) >= _KEPT:
            break
    return kept


def _apart(a: EpipolarFit, b: EpipolarFit) -> bool:
    return _angle(a.R, b.R) > 0.02 or _swing(a.t, b.t) > 0.05


def _angle(a: ndarray, b: ndarray) -> float:
    return float(np.linalg.norm(a - b) / np.sqrt(2))  # radian, for small angles


def _swing(a: ndarray, b: ndarray) -> float:
    return float(np.linalg.norm(a - b))


def _fitting(found: EpipolarFit) -> Bool[ndarray, "n"]:
    return np.abs(found.residual) <= 3 * found.noise_px
