"""Solutions for the relative pose of one frame, ranked by what they explain.

First solutions come from random samples and from the dominant plane. Each is refined, and all are compared at one
common width: the share of the correspondences that a solution explains counts, not how well it explains its best half.
Ranked by their own median residual, the false twin of a table that fills most of the view would win.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.robust import geman_mcclure_cost
from sl_nerfstudio.relative_pose.epipolar_fit import EpipolarFit, distinct_fits, fit_epipolar
from sl_nerfstudio.relative_pose.five_point import five_point_starts, in_front
from sl_nerfstudio.relative_pose.plane_starts import plane_starts
from sl_nerfstudio.relative_pose.ray_pairs import RayPairs, subsample
from sl_nerfstudio.relative_pose.sampson import sampson
from sl_nerfstudio.relative_pose.settings import RELATIVE_POSE_DEFAULTS, RelativePoseSettings


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
