"""Solutions for the relative pose of one frame, ranked by what they explain.

First solutions come from random samples of five correspondences (Nister, PAMI 2004, as in OpenCV) and from the plane
that holds most of them: its homography has two reconstructions in front of both devices (Longuet-Higgins, Proc. R.
Soc. B 1986), and where a table or a wall fills the view, few samples hold enough of what lies off it. Samples and
scores use rays, so every projector model is treated alike: what OpenCV takes for image points are rays divided by their
last component.

Each first solution is refined, and all are compared at one common width: the share of the correspondences that a
solution explains counts, not how well it explains its best half. Ranked by their own median residual, the false twin of
a table that fills most of the view would win.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from sl_nerfstudio.geometry.lie import cross, rotated
from sl_nerfstudio.geometry.numerics import geman_mcclure_cost
from sl_nerfstudio.parallel import compiled, compiled_sums
from sl_nerfstudio.relative_pose.epipolar import (
    KERNEL_SIGMAS,
    EpipolarFit,
    RayPairs,
    UnitPose,
    distance_from_curve,
    fit_epipolar,
    sampson,
    subsample,
)

SAMPLES = 100  # of five correspondences; with a third of them wrong, none is good with probability 1e-6
SCORING_RAYS = 300  # correspondences on which the solutions of all samples are scored
OUTLIER_PX = 4.0  # residual, projector pixels, beyond which a correspondence counts as wrong
LEAST_COSINE = 1e-3  # between a ray and the optical axis; others cannot be written as image points
STARTS = 8  # solutions from samples that are refined
FEWEST_IN_PLANE = 20  # correspondences with which a plane is looked for
LEAST_TRANSLATION = 1e-6  # distances of the plane; below it, two devices differ by a rotation alone
POLISHING_ITERATIONS, POLISHING_TOLERANCE = 12, 1e-6  # of the refinement of first solutions
VOTING_SIGMAS = 3.0  # noise within which a correspondence votes on which side the surface lies
LEAST_IN_FRONT = 0.5  # share of the votes
RIVAL_SHARE = 0.03  # of the correspondences that a rival may explain less than the best solution
RIVAL_ERRORS = 3.0  # standard errors of the difference within which a solution is a rival

Separation = tuple[float, float]  # angle between two rotations, radian, and distance of unit baselines
START_SEPARATION: Separation = (0.05, 0.1)
CANDIDATE_SEPARATION: Separation = (0.02, 0.05)


class RayCounts(NamedTuple):
    """Correspondences that are used at most: neighbouring pixels add nothing new."""

    fit: int
    polishing: int  # refinement of first solutions
    ranking: int  # comparison of the refined ones


USUAL_COUNTS = RayCounts(20_000, 800, 4000)


@dataclass(frozen=True)
class Candidate:
    """A solution that differs from the others."""

    fit: EpipolarFit
    explained: float  # share of the correspondences, each by how well it fits at the common width, in front of both
    rivals_best: bool  # it explains nearly as much as the best one, or the difference may be chance


def relative_pose_candidates(
    rays: RayPairs, rng: np.random.Generator, counts: RayCounts = USUAL_COUNTS
) -> list[Candidate]:
    """Distinct local optima with most rays meeting in front of both devices, the best first; may be empty."""
    starts = five_point_starts(rays, rng) + plane_starts(rays)
    some = rays.chosen(subsample(np.arange(len(rays)), counts.polishing, rng))
    fits = [fit_epipolar(R, t, some, POLISHING_ITERATIONS, POLISHING_TOLERANCE) for R, t in starts]
    found = distinct_fits([fit for fit in fits if _mostly_in_front(fit, some)], CANDIDATE_SEPARATION)
    return ranked(found, rays.chosen(subsample(np.arange(len(rays)), counts.ranking, rng)))


def five_point_starts(rays: RayPairs, rng: np.random.Generator) -> list[UnitPose]:
    """Poses of the best samples, without those close to a better one."""
    candidates = np.flatnonzero(_image_points(rays))
    if len(candidates) < 5:
        return []
    scoring_rays = rays.chosen(subsample(candidates, SCORING_RAYS, rng))
    samples = [rays.chosen(rng.choice(candidates, 5, replace=False)) for _ in range(SAMPLES)]
    matrices = [(E, sample) for sample in samples for E in essential_matrices(sample)]
    if not matrices:
        return []
    E, scores = np.stack([E for E, _ in matrices]), np.empty(len(matrices))
    parts = scoring_rays.d_camera, scoring_rays.d_projector, scoring_rays.d_projector_by_uv
    _score(E, *parts, OUTLIER_PX**2, scores)
    kept: list[UnitPose] = []
    for k in np.argsort(scores):
        E, sample = matrices[k]
        poses = [pose for pose in poses_of(E) if in_front(*pose, sample).sum() >= 4]  # usually one of four
        for pose in poses:
            if all(distinct(pose, other, START_SEPARATION) for other in kept):
                kept.append(pose)
        if len(kept) >= STARTS:
            break
    return kept


def plane_starts(rays: RayPairs) -> list[UnitPose]:
    """Poses that the dominant plane allows, with both signs of t; may be empty."""
    usable = _image_points(rays)
    if usable.sum() < FEWEST_IN_PLANE:
        return []
    camera, projector = (d[usable, :2] / d[usable, 2:] for d in (rays.d_camera, rays.d_projector))
    radian_per_px = float(np.median(np.linalg.norm(rays.d_projector_by_uv[usable], axis=(1, 2)))) / np.sqrt(2)
    H, _ = cv2.findHomography(projector, camera, cv2.RANSAC, OUTLIER_PX * radian_per_px)
    if H is None or not np.isfinite(H).all():
        return []
    count, rotations, translations, _ = cv2.decomposeHomographyMat(H, np.eye(3))
    out = []
    for k in range(count):
        length = float(np.linalg.norm(translations[k]))
        if length > LEAST_TRANSLATION:
            out += [(rotations[k], sign * translations[k][:, 0] / length) for sign in (1.0, -1.0)]
    return out


def _image_points(rays: RayPairs) -> Bool[ndarray, "n"]:
    """Pairs of which both rays can be written as image points."""
    return (rays.d_camera[:, 2] < -LEAST_COSINE) & (rays.d_projector[:, 2] < -LEAST_COSINE)


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


def poses_of(E: Float64[ndarray, "3 3"]) -> list[UnitPose]:
    """The four poses of an essential matrix."""
    R1, R2, t = cv2.decomposeEssentialMat(E)
    return [(R, s * t[:, 0] / np.linalg.norm(t)) for R in (R1, R2) for s in (1.0, -1.0)]


def in_front(R: Float64[ndarray, "3 3"], t: Float64[ndarray, "3"], rays: RayPairs) -> Bool[ndarray, "n"]:
    """Whether the two rays of each pair are nearest to each other in front of both devices."""
    front = np.empty(len(rays), dtype=np.bool_)
    _in_front(np.ascontiguousarray(R), t, rays.d_camera, rays.d_projector, front)
    return front


def distinct(a: UnitPose, b: UnitPose, separation: Separation) -> bool:
    """Whether two poses are two solutions rather than one."""
    rotation_rad = np.linalg.norm(a[0] - b[0]) / np.sqrt(2)  # for small angles
    return bool(rotation_rad > separation[0] or np.linalg.norm(a[1] - b[1]) > separation[1])


def distinct_fits(fits: Sequence[EpipolarFit], separation: Separation) -> list[EpipolarFit]:
    """Fits without those that are close to an earlier one: unfinished refinements may have the same end."""
    kept: list[EpipolarFit] = []
    for fit in fits:
        if all(distinct((fit.R, fit.t), (other.R, other.t), separation) for other in kept):
            kept.append(fit)
    return kept


def _mostly_in_front(fit: EpipolarFit, rays: RayPairs) -> bool:
    """False for the same essential matrix with the surface behind the devices."""
    fitting = np.abs(fit.residual) <= VOTING_SIGMAS * fit.noise_px
    return not in_front(fit.R, fit.t, rays)[fitting].mean() < LEAST_IN_FRONT


def ranked(fits: Sequence[EpipolarFit], rays: RayPairs) -> list[Candidate]:
    """Solutions by what they explain of the rays, the best first."""
    if not fits:
        return []
    width = KERNEL_SIGMAS * min(fit.noise_px for fit in fits)
    losses = [_losses(fit, rays, width) for fit in fits]
    order = np.argsort([loss.mean() for loss in losses], kind="stable").tolist()
    best = losses[order[0]]
    return [Candidate(fits[k], 1 - float(losses[k].mean()), _rivals(losses[k] - best, rays)) for k in order]


def _losses(fit: EpipolarFit, rays: RayPairs, width: float) -> Float64[ndarray, "n"]:
    """Loss of each correspondence between 0, explained, and 1, not at all."""
    loss = geman_mcclure_cost((sampson(fit.R, fit.t, rays) / width) ** 2)
    return np.where(in_front(fit.R, fit.t, rays), loss, 1.0)


def _rivals(difference: Float64[ndarray, "n"], rays: RayPairs) -> bool:
    """Whether a summed difference is small, or within chance; squares of the pattern are independent."""
    by_block = rays.block_sums(difference)
    errors = RIVAL_ERRORS * float(np.sqrt((by_block**2).sum()))
    return float(by_block.sum()) <= max(RIVAL_SHARE * len(difference), errors)


@compiled_sums
def _score(E, d_camera, d_projector, by_uv, limit, scores):
    """Mean of the squared residuals of every matrix, as `sampson`'s, each at most the limit, in units of it."""
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
    """Compare the signs of the depths along both rays where they are nearest to each other."""
    for i in range(len(front)):
        a, b, c = d_camera[i, 0], d_camera[i, 1], d_camera[i, 2]
        x, y, z = rotated(R, d_projector[i, 0], d_projector[i, 1], d_projector[i, 2])
        p, q, r = cross(a, b, c, x, y, z)
        u, v, w = cross(t[0], t[1], t[2], x, y, z)
        d, e, f = cross(t[0], t[1], t[2], a, b, c)
        front[i] = u * p + v * q + w * r > 0 and d * p + e * q + f * r > 0
