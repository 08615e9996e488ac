"""Which intrinsics are free: another one is, if left-out correspondences agree better with it."""

from dataclasses import replace
from itertools import combinations

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.robust import geman_mcclure_cost
from sl_nerfstudio.relative_pose.unknown_projector.joint_fit import JointFit, JointProblem, Prior
from sl_nerfstudio.relative_pose.unknown_projector.matches import Matches
from sl_nerfstudio.relative_pose.unknown_projector.parameters import K1, LOG_ASPECT, values_of
from sl_nerfstudio.relative_pose.unknown_projector.settings import UnknownProjectorSettings

_FURTHER = (LOG_ASPECT, K1)


def choose_model(matches: Matches, first: JointFit, prior: Prior, settings: UnknownProjectorSettings) -> JointFit:
    """`first`, or a fit with aspect, distortion or both free.

    Squares of the pattern are left out in turns (k-fold cross-validation), because errors within one depend on each
    other. The smallest model remains unless a larger one agrees better by some standard errors; of several, the one
    that agrees best.
    """
    some = matches.chosen(np.arange(len(matches.frame)) % (1 + len(matches.frame) // settings.choice_most) == 0)
    free = _significant(some, first, prior, settings)
    if not free:
        return first
    candidates = {
        tuple(sorted((*first.free, *extra))) for n in range(1, len(free) + 1) for extra in combinations(free, n)
    }
    base = _left_out(some, first, first.free, prior, settings)
    gains = [(*_gain(base, _left_out(some, first, one, prior, settings), some), one) for one in sorted(candidates)]
    good = [(total, one) for total, error, one in gains if total > settings.standard_errors * error]
    if not good:
        return first
    return JointProblem(matches, first.projector, max(good)[1], prior, settings.fit).fit(first.poses)


def _significant(
    matches: Matches, first: JointFit, prior: Prior, settings: UnknownProjectorSettings
) -> tuple[int, ...]:
    """Further intrinsics that depart from their usual values by some standard deviations, if all are free.

    The others cannot improve left-out correspondences by more than chance.
    """
    fit = replace(settings.fit, iterations=settings.fold_iterations)
    found = JointProblem(matches, first.projector, (*first.free, *_FURTHER), prior, fit).fit(first.poses)
    away = np.abs(values_of(found.projector) - values_of(first.projector))[list(_FURTHER)]
    sigma = np.sqrt(np.diag(found.covariance))[len(first.free) :]
    return tuple(k for k, far in zip(_FURTHER, away > settings.standard_errors * sigma, strict=True) if far)


def _left_out(
    matches: Matches, first: JointFit, free: tuple[int, ...], prior: Prior, settings: UnknownProjectorSettings
) -> Float64[ndarray, "n"]:
    """Robust cost of every correspondence under the fit to the others."""
    width = settings.fit.kernel_sigmas * first.noise_px
    fold = np.unique(matches.block, return_inverse=True)[1] * 7919 % settings.folds
    out = np.zeros(len(matches.frame))
    fit = replace(settings.fit, iterations=settings.fold_iterations)
    for k in range(settings.folds):
        kept, left = matches.chosen(fold != k), matches.chosen(fold == k)
        found = JointProblem(kept, first.projector, free, prior, fit).fit(first.poses)
        r = left.residuals(found.poses, left.rays(found.projector))
        out[fold == k] = geman_mcclure_cost((np.nan_to_num(r, nan=1e6) / width).clip(-1e6, 1e6) ** 2)
    return out


def _gain(base: Float64[ndarray, "n"], other: Float64[ndarray, "n"], matches: Matches) -> tuple[float, float]:
    """By how much the other model costs less, and the standard error; squares are independent."""
    _, block = np.unique(matches.block, return_inverse=True)
    sums = np.bincount(block, base - other)
    return float(sums.sum()), float(np.sqrt((sums**2).sum()))
