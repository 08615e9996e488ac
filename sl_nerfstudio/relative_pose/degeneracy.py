"""Captures from which the relative pose follows badly or not at all, told apart and named."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.relative_pose.epipolar_fit import EpipolarFit, kernel_weight
from sl_nerfstudio.relative_pose.ray_pairs import RayPairs

Kind = Literal[
    "few points",
    "small part of the pattern",
    "planar",
    "tiny baseline",
    "epipole in view",
    "ambiguous",
    "many outliers",
    "poor fit",
    "uncertain",
]

_FEW_BLOCKS = 30  # squares of the pattern with points in them: fewer bear no statement about their errors either
_FEW_POINTS = 200
_RELIEF = 6.0  # standard deviations of the noise by which points must depart from a plane, or from a mere rotation
_ANGLE_DEG = 2.0  # between camera ray and projector ray, below which depth hangs on tiny errors
_OUTLIERS = 0.3
_POOR_PX = 2.0
_RIVAL = 1.3  # noise of the second best solution, relative to the best
_UNCERTAIN_DEG = (0.5, 1.5)  # rotation, direction of the baseline


@dataclass(frozen=True)
class Degeneracy:
    """One reason to trust a frame's calibration less; `message` says what was found and what to do."""

    kind: Kind
    value: float
    message: str


def find_degeneracies(
    found: EpipolarFit,
    rays: RayPairs,
    inlier: ndarray,
    sigma_deg: tuple[float, float],
    rival: EpipolarFit | None,
) -> tuple[Degeneracy, ...]:
    """All weak cases that the correspondences of a frame show. `rival` is the second best distinct solution."""
    good = rays.chosen(inlier)
    blocks = len(np.unique(good.block))
    noise = found.noise_px
    plane, turn = plane_relief(good), rotation_relief(good)
    angle = float(np.degrees(np.median(ray_angles(found, good))))
    outliers = 1 - float(inlier.mean())
    rules: tuple[tuple[bool, Kind, float, str], ...] = (
        (len(good) < _FEW_POINTS, "few points", len(good), f"only {len(good)} decoded pixels agree with each other; "
         "capture the object larger in the image, or with more light"),
        (blocks < _FEW_BLOCKS, "small part of the pattern", blocks, f"decoded pixels cover {blocks} of 625 squares of "
         "the pattern; let more of the pattern fall on the object"),
        (turn < _RELIEF * noise, "tiny baseline", turn / noise, "a turn of the projector without any distance to the "
         f"camera explains the coordinates to {turn:.2g} px; hold the projector farther from the camera"),
        (turn >= _RELIEF * noise and angle < _ANGLE_DEG, "tiny baseline", angle, f"camera rays and projector rays meet "
         f"at {angle:.2g} degrees; hold the projector farther from the camera"),
        (turn >= _RELIEF * noise and plane < _RELIEF * noise, "planar", plane / noise, "all points lie in one plane to "
         f"{plane:.2g} px, and a plane leaves the pose open; let the frame see parts at other depths"),
        (epipole_in_view(found, good), "epipole in view", 1.0, "one device stands in the other's view of the object; "
         "around that place depth cannot be measured; move the projector to the side"),
        (rival is not None and rival.noise_px < _RIVAL * noise, "ambiguous", rival.noise_px / noise if rival else 0.0,
         "a second pose explains the coordinates nearly as well; let the frame see parts at other depths"),
        (outliers > _OUTLIERS, "many outliers", outliers, f"{outliers:.0%} of the coordinates contradict the rest; "
         "check the pattern file and the light"),
        (noise > _POOR_PX, "poor fit", noise, f"coordinates miss their epipolar curves by {noise:.2g} px; check the "
         "intrinsics of both devices and the projector's model (OPENCV or DOE)"),
        (sigma_deg[0] > _UNCERTAIN_DEG[0] or sigma_deg[1] > _UNCERTAIN_DEG[1], "uncertain", max(sigma_deg),
         f"the pose is known to {sigma_deg[0]:.2g} deg (rotation) and {sigma_deg[1]:.2g} deg (baseline) only"),
    )  # fmt: skip
    return tuple(Degeneracy(kind, float(value), message) for holds, kind, value, message in rules if holds)


def plane_relief(rays: RayPairs) -> float:
    """Robust RMS, in projector pixels, of what the best homography between the two views leaves."""
    return _homography_residual(rays)


def rotation_relief(rays: RayPairs) -> float:
    """Robust RMS, in projector pixels, of what the best mere rotation between the two devices leaves."""
    w = np.full(len(rays), 1.0)
    r = np.zeros(len(rays))
    for _ in range(10):
        U, _, Vt = np.linalg.svd((rays.d_projector * w[:, None]).T @ rays.d_camera)
        sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
        r = _miss(rays.d_camera @ ((U * sign) @ Vt).T, rays)
        w = kernel_weight(r, 3 * max(float(np.median(r)), 1e-9))
    return _spread(r)


def _homography_residual(rays: RayPairs) -> float:
    w = np.full(len(rays), 1.0)
    r = np.zeros(len(rays))
    d_c, d_p = rays.d_camera, rays.d_projector
    scale = np.linalg.norm(rays.d_projector_by_uv, axis=(1, 2))[:, None]  # radian a pixel: residuals become pixels
    rows = [np.concatenate([_cross_row(d_p, axis)[:, None, k] * d_c for k in range(3)], 1) / scale for axis in range(3)]
    for _ in range(10):
        A = np.concatenate([row * np.sqrt(w)[:, None] for row in rows])
        H = np.linalg.eigh(A.T @ A)[1][:, 0].reshape(3, 3)
        mapped = d_c @ H.T
        mapped = mapped * np.sign((mapped * d_p).sum(-1, keepdims=True))
        r = _miss(mapped / np.linalg.norm(mapped, axis=-1, keepdims=True).clip(1e-300), rays)
        w = kernel_weight(r, 3 * max(float(np.median(r)), 1e-9))
    return _spread(r)


def _cross_row(d: Float64[ndarray, "n 3"], axis: int) -> Float64[ndarray, "n 3"]:
    """Row `axis` of the matrix of the cross product with each `d`."""
    out = np.zeros_like(d)
    out[:, (axis + 1) % 3] = -d[:, (axis + 2) % 3]
    out[:, (axis + 2) % 3] = d[:, (axis + 1) % 3]
    return out


def _miss(predicted: Float64[ndarray, "n 3"], rays: RayPairs) -> Float64[ndarray, "n"]:
    """Distance of predicted projector rays from the decoded ones, in projector pixels."""
    X = rays.d_projector_by_uv
    inverse = np.linalg.inv(np.einsum("nic,nid->ncd", X, X))
    gap = np.einsum("nic,ni->nc", X, predicted - rays.d_projector)
    return np.sqrt((np.einsum("ncd,nd->nc", inverse, gap) ** 2).sum(-1))


def _spread(r: Float64[ndarray, "n"]) -> float:
    """RMS of the smaller nine tenths: relief may stand in a corner of the image, wrong coordinates do, too."""
    kept = np.sort(r)[: max(1, int(0.9 * len(r)))]
    return float(np.sqrt((kept**2).mean()))


def ray_angles(found: EpipolarFit, rays: RayPairs) -> Float64[ndarray, "n"]:
    """Angles, in radian, at which camera rays and projector rays meet."""
    d_p = rays.d_projector @ found.R.T
    return np.arctan2(np.linalg.norm(np.cross(rays.d_camera, d_p), axis=-1), (rays.d_camera * d_p).sum(-1))


def epipole_in_view(found: EpipolarFit, rays: RayPairs) -> bool:
    """Whether one device, or its mirror image behind, lies within the cone of rays that see the object."""
    return _inside(found.t, rays.d_camera) or _inside(found.R.T @ found.t, rays.d_projector)


def _inside(axis: Float64[ndarray, "3"], directions: Float64[ndarray, "n 3"]) -> bool:
    """Whether the line of `axis` is surrounded by directions: some within reach in all eight sectors around it."""
    axis = axis * np.sign(axis @ directions.mean(0))
    helper = np.eye(3)[np.abs(axis).argmin()]
    u = np.cross(axis, helper)
    u = u / np.linalg.norm(u)
    angle = np.arctan2(directions @ np.cross(axis, u), directions @ u)
    if axis @ directions.mean(0) <= 0:
        return False
    return len(np.unique(np.floor((angle + np.pi) / (np.pi / 4)).astype(int).clip(0, 7))) == 8
