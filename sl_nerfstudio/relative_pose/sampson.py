"""Sampson's residual of a relative pose, and increments of the pose.

The residual is the distance, to first order, of a decoded coordinate from the epipolar curve of its camera pixel, in
projector pixels. Only the projector's side has an error, because camera pixels are exact centres. It is computed from
rays alone and therefore holds for pinhole, distorted and diffractive projectors.

Five unknowns (w, b): `R <- exp(w) R` rotates the projector about its own centre, in camera axes, and
`t <- exp(B b) t` rotates the unit baseline, where B = `direction_basis(t)` spans the plane perpendicular to it.
"""

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.relative_pose.ray_pairs import RayPairs


def direction_basis(t: Float64[ndarray, "3"]) -> Float64[ndarray, "3 2"]:
    """Two unit vectors perpendicular to `t` and to each other, the same ones for the same `t`."""
    helper = np.eye(3)[np.abs(t).argmin()]
    first = np.cross(t, helper)
    first = first / np.linalg.norm(first)
    return np.stack([first, np.cross(t, first)], 1)


def moved(
    R: Float64[ndarray, "3 3"], t: Float64[ndarray, "3"], step: Float64[ndarray, "5"]
) -> tuple[Float64[ndarray, "3 3"], Float64[ndarray, "3"]]:
    """The pose after an increment (w, b)."""
    rotation, of_baseline = Rotation.from_rotvec(step[:3]), Rotation.from_rotvec(direction_basis(t) @ step[3:])
    t = of_baseline.apply(t)
    return rotation.as_matrix() @ R, t / np.linalg.norm(t)


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
