"""Solutions for the relative pose of one frame, ranked by what they explain.

First solutions come from random samples and from the dominant plane. Each is refined, and all are compared at one
common width: the share of the correspondences that a solution explains counts, not how well it explains its best half.
Ranked by their own median residual, the false twin of a table that fills most of the view would win.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from sl_nerfstudio.geometry.numerics import geman_mcclure_cost, geman_mcclure_weight
from sl_nerfstudio.parallel import compiled, compiled_sums
from sl_nerfstudio.relative_pose.epipolar import (
    RELATIVE_POSE_DEFAULTS,
    DegeneracyLimits,
    EpipolarFit,
    PlaneSettings,
    RayPairs,
    RelativePoseSettings,
    SeparationSettings,
    distance_from_curve,
    distinct,
    distinct_fits,
    fit_epipolar,
    sampson,
    subsample,
)

# First solutions for the pose of a projector relative to its camera, by five-point samples.
#
# Random samples are solved (Nister, PAMI 2004, as in OpenCV) and scored. Samples and scores use rays, so every
# projector
# model is treated alike: what OpenCV takes for image points are rays divided by their last component.


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
    ranked: Iterable[tuple[ndarray, RayPairs]], count: int, separation: SeparationSettings
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


# How far correspondences depart from a plane and from a pure rotation, of which neither determines a relative pose.


def plane_relief(rays: RayPairs, settings: DegeneracyLimits = RELATIVE_POSE_DEFAULTS.degeneracy) -> float:
    """Robust RMS, in projector pixels, of what the best homography between the two views leaves."""
    w = np.full(len(rays), 1.0)
    r = np.zeros(len(rays))
    d_c, d_p = rays.d_camera, rays.d_projector
    scale = np.linalg.norm(rays.d_projector_by_uv, axis=(1, 2))[:, None]  # radian a pixel: residuals become pixels
    rows = [np.concatenate([_cross_row(d_p, axis)[:, None, k] * d_c for k in range(3)], 1) / scale for axis in range(3)]
    for _ in range(settings.relief_iterations):
        A = np.concatenate([row * np.sqrt(w)[:, None] for row in rows])
        H = np.linalg.eigh(A.T @ A)[1][:, 0].reshape(3, 3)
        mapped = d_c @ H.T
        mapped = mapped * np.sign((mapped * d_p).sum(-1, keepdims=True))
        r = _error_px(mapped / np.linalg.norm(mapped, axis=-1, keepdims=True).clip(1e-300), rays)
        w = _weights(r, settings)
    return _trimmed_rms(r, settings.relief_share)


def rotation_relief(rays: RayPairs, settings: DegeneracyLimits = RELATIVE_POSE_DEFAULTS.degeneracy) -> float:
    """Robust RMS, in projector pixels, of what the best pure rotation between the two devices leaves."""
    w = np.full(len(rays), 1.0)
    r = np.zeros(len(rays))
    for _ in range(settings.relief_iterations):
        U, _, Vt = np.linalg.svd((rays.d_projector * w[:, None]).T @ rays.d_camera)
        sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
        r = _error_px(rays.d_camera @ ((U * sign) @ Vt).T, rays)
        w = _weights(r, settings)
    return _trimmed_rms(r, settings.relief_share)


def _weights(r: Float64[ndarray, "n"], settings: DegeneracyLimits) -> Float64[ndarray, "n"]:
    width = settings.relief_kernel_medians * max(float(np.median(r)), 1e-9)
    return geman_mcclure_weight((r / width) ** 2)


def _cross_row(d: Float64[ndarray, "n 3"], axis: int) -> Float64[ndarray, "n 3"]:
    """Row `axis` of the matrix of the cross product with each `d`."""
    out = np.zeros_like(d)
    out[:, (axis + 1) % 3] = -d[:, (axis + 2) % 3]
    out[:, (axis + 2) % 3] = d[:, (axis + 1) % 3]
    return out


def _error_px(predicted: Float64[ndarray, "n 3"], rays: RayPairs) -> Float64[ndarray, "n"]:
    """Distance of predicted projector rays from the decoded ones, in projector pixels."""
    out = np.empty(len(rays))
    _gaps_px(predicted, rays.d_projector, rays.d_projector_by_uv, out)
    return out


@compiled
def _gaps_px(predicted, decoded, by_uv, out):
    """By least squares: the pixels whose change explains the gap between two rays best."""
    for n in range(len(out)):
        aa, ab, bb, a, b = 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(3):
            by_u, by_v, gap = by_uv[n, i, 0], by_uv[n, i, 1], predicted[n, i] - decoded[n, i]
            aa += by_u * by_u
            ab += by_u * by_v
            bb += by_v * by_v
            a += by_u * gap
            b += by_v * gap
        out[n] = np.hypot(bb * a - ab * b, aa * b - ab * a) / (aa * bb - ab * ab)


def _trimmed_rms(r: Float64[ndarray, "n"], share: float) -> float:
    """RMS of the smallest residuals: all that depart may be one corner of the image, and so may wrong coordinates."""
    kept = np.sort(r)[: max(1, int(share * len(r)))]
    return float(np.sqrt((kept**2).mean()))


# First solutions for the relative pose from the plane that holds most of the correspondences.
#
# Two views of a plane are related by a homography, which has two reconstructions in front of both devices (Longuet-
# Higgins, Proc. R. Soc. B 1986). Only what lies off the plane tells the true one from its twin, and where a table
# or a
# wall fills the view, few random samples of five hold enough of that. Both are therefore always among the first
# solutions; `candidates` decides by everything else that was decoded.


def plane_starts(
    rays: RayPairs, settings: PlaneSettings = RELATIVE_POSE_DEFAULTS.plane
) -> list[tuple[Float64[ndarray, "3 3"], Float64[ndarray, "3"]]]:
    """Poses (R, t), projector to camera, |t| = 1, that the dominant plane allows; both signs of t; may be empty."""
    usable = (rays.d_camera[:, 2] < -settings.least_cosine) & (rays.d_projector[:, 2] < -settings.least_cosine)
    if usable.sum() < settings.fewest:
        return []
    # Image points of a device that looks along +z: rays divided by their last component.
    camera, projector = (d[usable, :2] / d[usable, 2:] for d in (rays.d_camera, rays.d_projector))
    radian_per_px = float(np.median(np.linalg.norm(rays.d_projector_by_uv[usable], axis=(1, 2)))) / np.sqrt(2)
    H, _ = cv2.findHomography(projector, camera, cv2.RANSAC, settings.outlier_px * radian_per_px)
    if H is None or not np.isfinite(H).all():
        return []
    count, rotations, translations, _ = cv2.decomposeHomographyMat(H, np.eye(3))
    out = []
    for k in range(count):
        length = float(np.linalg.norm(translations[k]))
        if length > settings.least_translation:
            out += [(rotations[k], sign * translations[k][:, 0] / length) for sign in (1.0, -1.0)]
    return out


@dataclass(frozen=True)
class Candidate:
    """A solution that differs from the others."""

    fit: EpipolarFit
    explained: float  # share of the correspondences, each by how well it fits at the common width, in front of both
    rivals_best: bool  # it explains nearly as much as the best one, or the difference may be chance


def relative_pose_candidates(
    rays: RayPairs, rng: np.random.Generator, settings: RelativePoseSettings = RELATIVE_POSE_DEFAULTS
) -> list[Candidate]:
    """Distinct local optima with most rays meeting in front of both devices, the best first; may be empty."""
    s = settings.candidates
    starts = five_point_starts(rays, rng, settings) + plane_starts(rays, settings.plane)
    polishing_rays = rays.chosen(subsample(np.arange(len(rays)), s.polishing_rays, rng))
    polishing = replace(settings.fit, iterations=s.polishing_iterations)
    fits = [fit_epipolar(R, t, polishing_rays, polishing) for R, t in starts]
    found = distinct_fits((fit for fit in fits if _mostly_in_front(fit, polishing_rays, settings)), s.separation)
    return ranked(found, rays.chosen(subsample(np.arange(len(rays)), s.ranking_rays, rng)), settings)


def _mostly_in_front(fit: EpipolarFit, rays: RayPairs, settings: RelativePoseSettings) -> bool:
    """False for the same essential matrix with the surface behind the devices."""
    s = settings.candidates
    fitting = np.abs(fit.residual) <= s.inlier_sigmas * fit.noise_px
    return not in_front(fit.R, fit.t, rays)[fitting].mean() < s.least_in_front


def ranked(fits: Sequence[EpipolarFit], rays: RayPairs, settings: RelativePoseSettings) -> list[Candidate]:
    """Solutions by what they explain of the rays, the best first."""
    if not fits:
        return []
    s = settings.candidates
    width = settings.fit.kernel_sigmas * min(fit.noise_px for fit in fits)
    losses = [_losses(fit, rays, width) for fit in fits]
    order = np.argsort([loss.mean() for loss in losses], kind="stable").tolist()
    best = losses[order[0]]
    return [
        Candidate(fits[k], 1 - float(losses[k].mean()), _rivals(losses[k] - best, rays, s.rival_share, s.rival_errors))
        for k in order
    ]


def _losses(fit: EpipolarFit, rays: RayPairs, width: float) -> Float64[ndarray, "n"]:
    """Of each correspondence between 0, explained, and 1, not at all."""
    loss = geman_mcclure_cost((sampson(fit.R, fit.t, rays) / width) ** 2)
    return np.where(in_front(fit.R, fit.t, rays), loss, 1.0)


def _rivals(difference: Float64[ndarray, "n"], rays: RayPairs, share: float, errors: float) -> bool:
    """Whether a summed difference is small, or within chance; squares of the pattern are independent."""
    by_block = rays.block_sums(difference)
    total = float(by_block.sum())
    return total <= max(share * len(difference), errors * float(np.sqrt((by_block**2).sum())))
