"""Robust non-linear fit of a projector's pose against its camera, up to the length of the baseline.

The residual is Sampson's: the distance, to first order, of a decoded coordinate from the epipolar curve of its
camera pixel, in projector pixels. Only the projector's side has an error, because camera pixels are exact centres.
It is built from rays alone and therefore holds for pinhole, distorted and diffractive projectors.

Five unknowns (w, b): `R <- exp(w) R` turns the projector about its own centre, in camera axes, and
`t <- exp(B b) t` swings the unit baseline in the plane square to it, whose basis is B = `direction_basis(t)`.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.relative_pose.ray_pairs import RayPairs

NOISE_FLOOR = 1e-3  # projector pixels: no fit is believed to be better than this
_KERNEL = 3.0  # width of the robust kernel, in standard deviations of the residuals
_NORMAL = 1.4826  # standard deviation over median absolute deviation, of a normal distribution
_CONVERGED = 1e-10  # radian


@dataclass(frozen=True)
class EpipolarFit:
    """A relative pose with unit baseline, and how well it is known."""

    R: Float64[ndarray, "3 3"]  # projector to camera
    t: Float64[ndarray, "3"]  # unit direction from the camera to the projector, in camera axes
    residual: Float64[ndarray, "n"]  # projector pixels
    noise_px: float  # robust standard deviation of the residuals
    cost: float  # robust sum of squared residuals over that of outliers alone: 0 perfect, 1 nothing fits


def direction_basis(t: Float64[ndarray, "3"]) -> Float64[ndarray, "3 2"]:
    """Two unit vectors square to `t` and to each other, the same ones for the same `t`."""
    helper = np.eye(3)[np.abs(t).argmin()]
    first = np.cross(t, helper)
    first = first / np.linalg.norm(first)
    return np.stack([first, np.cross(t, first)], 1)


def moved(
    R: Float64[ndarray, "3 3"], t: Float64[ndarray, "3"], step: Float64[ndarray, "5"]
) -> tuple[Float64[ndarray, "3 3"], Float64[ndarray, "3"]]:
    """The pose after an increment (w, b)."""
    turn, swing = Rotation.from_rotvec(step[:3]), Rotation.from_rotvec(direction_basis(t) @ step[3:])
    t = swing.apply(t)
    return turn.as_matrix() @ R, t / np.linalg.norm(t)


def sampson(R: Float64[ndarray, "3 3"], t: Float64[ndarray, "3"], rays: RayPairs) -> Float64[ndarray, "n"]:
    """Signed distances of the coordinates from their epipolar curves, in projector pixels."""
    a, h, _ = _parts(R, t, rays)
    return a / np.sqrt((h * h).sum(-1)).clip(1e-300)


def sampson_jacobian(
    R: Float64[ndarray, "3 3"], t: Float64[ndarray, "3"], rays: RayPairs
) -> tuple[Float64[ndarray, "n"], Float64[ndarray, "n 5"]]:
    """Residuals and their derivatives by (w, b)."""
    a, h, n = _parts(R, t, rays)
    g = np.sqrt((h * h).sum(-1)).clip(1e-300)
    normal_by_b = _hat(rays.d_camera) @ (_hat(t) @ direction_basis(t))
    m = np.concatenate([_hat(n), normal_by_b], -1)
    m = R.T @ m  # derivative of the normal in projector axes, by all five unknowns
    da = np.einsum("ni,nij->nj", rays.d_projector, m)
    dh = np.einsum("nik,nij->nkj", rays.d_projector_by_uv, m)
    dg = np.einsum("nk,nkj->nj", h, dh) / g[:, None]
    return a / g, (da - (a / g)[:, None] * dg) / g[:, None]


def _parts(R: Float64[ndarray, "3 3"], t: Float64[ndarray, "3"], rays: RayPairs) -> tuple[ndarray, ndarray, ndarray]:
    """Algebraic residual, its gradient by the projector's pixel, and normals of the epipolar planes (camera axes)."""
    n = np.cross(t, rays.d_camera)
    m = n @ R
    return (m * rays.d_projector).sum(-1), np.einsum("ni,nik->nk", m, rays.d_projector_by_uv), n


def _hat(v: Float64[ndarray, "*n 3"]) -> Float64[ndarray, "*n 3 3"]:
    x, y, z = np.moveaxis(v, -1, 0)
    o = np.zeros_like(x)
    return np.stack([o, -z, y, z, o, -x, -y, x, o], -1).reshape(*v.shape[:-1], 3, 3)


def noise_of(residual: Float64[ndarray, "n"]) -> float:
    """Robust standard deviation about zero."""
    return max(_NORMAL * float(np.median(np.abs(residual))), NOISE_FLOOR)


def kernel_weight(residual: Float64[ndarray, "n"], width: float) -> Float64[ndarray, "n"]:
    """Geman-McClure: 1 for small residuals, falling with their fourth power beyond `width`."""
    return 1 / (1 + (residual / width) ** 2) ** 2


def fit_epipolar(
    R: Float64[ndarray, "3 3"], t: Float64[ndarray, "3"], rays: RayPairs, iterations: int = 30
) -> EpipolarFit:
    """Levenberg-Marquardt from a start; the kernel narrows to three times the noise and never widens again.

    The start need only be a few degrees good (graduated non-convexity).
    """
    damping, step_size = 1e-4, np.inf
    width = np.inf
    for _ in range(iterations):
        r, J = sampson_jacobian(R, t, rays)
        width = min(width, _KERNEL * noise_of(r))
        w = kernel_weight(r, width)
        H, g = (J * w[:, None]).T @ J, J.T @ (w * r)
        cost = _cost(r, width)
        for _ in range(8):
            step = -np.linalg.lstsq(H + damping * np.diag(np.diag(H)), g, rcond=1e-14)[0]
            R_new, t_new = moved(R, t, step)
            if _cost(sampson(R_new, t_new, rays), width) <= cost:
                R, t, damping, step_size = R_new, t_new, max(damping / 10, 1e-12), float(np.abs(step).max())
                break
            damping *= 10
        else:
            break
        if step_size < _CONVERGED:
            break
    r = sampson(R, t, rays)
    return EpipolarFit(R, t, r, noise_of(r), _cost(r, width) / (len(r) * width**2))


def _cost(r: Float64[ndarray, "n"], width: float) -> float:
    r2 = r * r
    return float((r2 / (1 + r2 / width**2)).sum())


def covariance(found: EpipolarFit, rays: RayPairs) -> Float64[ndarray, "5 5"]:
    """Covariance of (w, b), robust against errors that go together (the cluster-robust sandwich estimator).

    Within a block of the pattern residuals may depend on each other in any way: their pulls are summed before they are
    squared (Liang and Zeger, Biometrika 1986). Errors that go together over longer distances, such as wrong lens
    parameters, cannot be seen by any frame alone and are not included.
    """
    r, J = sampson_jacobian(found.R, found.t, rays)
    width = _KERNEL * found.noise_px
    w = kernel_weight(r, width)
    x = (r / width) ** 2
    curvature = w - 4 * x / (1 + x) ** 3  # of the kernel: what a residual adds to the cost's second derivative
    bread = (J * curvature[:, None]).T @ J
    if np.linalg.eigvalsh(bread)[0] <= 0:
        bread = (J * w[:, None]).T @ J
    _, group = np.unique(rays.block, return_inverse=True)
    blocks = int(group.max()) + 1
    pull = np.zeros((blocks, 5))
    np.add.at(pull, group, J * (w * r)[:, None])
    meat = pull.T @ pull * (blocks / max(blocks - 5, 1))
    # the noise believed at least, where everything fits exactly
    meat = meat + NOISE_FLOOR**2 * (J.T @ J)
    inverse = np.linalg.pinv(bread, rcond=1e-14, hermitian=True)
    return inverse @ meat @ inverse
