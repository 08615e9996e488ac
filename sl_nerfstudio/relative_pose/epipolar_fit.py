"""Robust non-linear fit of a projector's pose relative to its camera, with its covariance.

The length of the baseline is one. Residuals and unknowns are those of `sampson`.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.robust import MAD_TO_SIGMA, geman_mcclure_cost, geman_mcclure_weight
from sl_nerfstudio.relative_pose.ray_pairs import RayPairs
from sl_nerfstudio.relative_pose.sampson import moved, sampson, sampson_jacobian
from sl_nerfstudio.relative_pose.settings import RELATIVE_POSE_DEFAULTS, EpipolarFitSettings, Separation


@dataclass(frozen=True)
class EpipolarFit:
    """A relative pose with unit baseline, and how well it fits."""

    R: Float64[ndarray, "3 3"]  # projector to camera
    t: Float64[ndarray, "3"]  # unit direction from the camera to the projector, in camera axes
    residual: Float64[ndarray, "n"]  # projector pixels
    noise_px: float  # robust standard deviation of the residuals
    cost: float  # robust sum of squared residuals over that of outliers alone: 0 perfect, 1 nothing fits


def noise_of(residual: Float64[ndarray, "n"], floor_px: float = RELATIVE_POSE_DEFAULTS.fit.noise_floor_px) -> float:
    """Robust standard deviation about zero."""
    return max(MAD_TO_SIGMA * float(np.median(np.abs(residual))), floor_px)


def distinct(
    a: tuple[Float64[ndarray, "3 3"], Float64[ndarray, "3"]],
    b: tuple[Float64[ndarray, "3 3"], Float64[ndarray, "3"]],
    separation: Separation,
) -> bool:
    """Whether two poses (R, t) are two solutions rather than one."""
    rotation_rad = np.linalg.norm(a[0] - b[0]) / np.sqrt(2)  # for small angles
    return bool(rotation_rad > separation.rotation_rad or np.linalg.norm(a[1] - b[1]) > separation.direction)


def distinct_fits(fits: Iterable[EpipolarFit], separation: Separation) -> list[EpipolarFit]:
    """Without those that are close to an earlier one: unfinished refinements may have the same end."""
    kept: list[EpipolarFit] = []
    for fit in fits:
        if all(distinct((fit.R, fit.t), (other.R, other.t), separation) for other in kept):
            kept.append(fit)
    return kept


def fit_epipolar(
    R: Float64[ndarray, "3 3"],
    t: Float64[ndarray, "3"],
    rays: RayPairs,
    settings: EpipolarFitSettings = RELATIVE_POSE_DEFAULTS.fit,
) -> EpipolarFit:
    """Levenberg-Marquardt from a start that is right to within a few degrees.

    The kernel follows the noise as it falls, and never widens again (graduated non-convexity).
    """
    damping, step_size = settings.damping, np.inf
    width = np.inf
    for _ in range(settings.iterations):
        r, J = sampson_jacobian(R, t, rays)
        width = min(width, settings.kernel_sigmas * noise_of(r, settings.noise_floor_px))
        w = geman_mcclure_weight((r / width) ** 2)
        H, g = (J * w[:, None]).T @ J, J.T @ (w * r)
        cost = _cost(r, width)
        for _ in range(settings.tries):
            step = -np.linalg.lstsq(H + damping * np.diag(np.diag(H)), g, rcond=1e-14)[0]
            R_new, t_new = moved(R, t, step)
            if _cost(sampson(R_new, t_new, rays), width) <= cost:
                R, t, step_size = R_new, t_new, float(np.abs(step).max())
                damping = max(damping / settings.damping_factor, settings.least_damping)
                break
            damping *= settings.damping_factor
        else:
            break
        if step_size < settings.converged_rad:
            break
    r = sampson(R, t, rays)
    return EpipolarFit(R, t, r, noise_of(r, settings.noise_floor_px), _cost(r, width) / (len(r) * width**2))


def _cost(r: Float64[ndarray, "n"], width: float) -> float:
    return width**2 * float(geman_mcclure_cost((r / width) ** 2).sum())


def covariance(
    found: EpipolarFit, rays: RayPairs, settings: EpipolarFitSettings = RELATIVE_POSE_DEFAULTS.fit
) -> Float64[ndarray, "5 5"]:
    """Covariance of (w, b), robust against errors that depend on each other (the cluster-robust sandwich estimator).

    Within a square of the pattern residuals may depend on each other in any way: their gradients are summed before
    they are squared (Liang and Zeger, Biometrika 1986). Errors that are shared over longer distances, such as wrong
    lens parameters, cannot be seen in any frame alone and are not included.
    """
    r, J = sampson_jacobian(found.R, found.t, rays)
    width = settings.kernel_sigmas * found.noise_px
    x = (r / width) ** 2
    w = geman_mcclure_weight(x)
    curvature = w - 4 * x / (1 + x) ** 3  # of the kernel: what a residual adds to the cost's second derivative
    bread = (J * curvature[:, None]).T @ J
    if np.linalg.eigvalsh(bread)[0] <= 0:
        bread = (J * w[:, None]).T @ J
    gradients = rays.block_sums(J * (w * r)[:, None])
    blocks = len(gradients)
    meat = gradients.T @ gradients * (blocks / max(blocks - 5, 1))
    # Where everything fits exactly, the least noise is assumed.
    meat = meat + settings.noise_floor_px**2 * (J.T @ J)
    inverse = np.linalg.pinv(bread, rcond=1e-14, hermitian=True)
    return inverse @ meat @ inverse
