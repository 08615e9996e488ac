"""How far correspondences depart from a plane and from a pure rotation, of which neither determines a relative pose."""

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.compiled import compiled
from sl_nerfstudio.geometry.robust import geman_mcclure_weight
from sl_nerfstudio.relative_pose.ray_pairs import RayPairs
from sl_nerfstudio.relative_pose.settings import RELATIVE_POSE_DEFAULTS, DegeneracyLimits


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
