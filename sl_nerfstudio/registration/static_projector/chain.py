"""Cameras placed by the codes alone: two views first, then one camera after the other against the known points.

Normalised coordinates are OpenCV's here (y down, looking along +z); poses are those of the devices (looking along -z).
"""

from collections.abc import Sequence
from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.registration.static_projector.cells import Cells
from sl_nerfstudio.registration.static_projector.settings import ChainSettings
from sl_nerfstudio.relative_pose.ray_pairs import directions


def rays_of(cells: Cells, cameras: Sequence[Device]) -> Float64[ndarray, "frames cells 3"]:
    """Unit rays in each camera's axes; NaN where it does not see the square."""
    return np.stack([directions(camera, uv) for camera, uv in zip(cameras, cells.uv_camera, strict=True)])


def image_points(d: Float64[ndarray, "n 3"]) -> Float64[ndarray, "n 2"]:
    """Normalised coordinates of rays, y down."""
    return np.stack([d[:, 0] / -d[:, 2], d[:, 1] / d[:, 2]], -1)


def pose_from_opencv(R: Float64[ndarray, "3 3"], t: Float64[ndarray, "3"]) -> Float64[ndarray, "4 4"]:
    """T_world_device from OpenCV's R, t, which map points of the world to the device."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R.T @ _flip(), -R.T @ t
    return T


def _flip() -> Float64[ndarray, "3 3"]:
    """Between the axes of OpenCV and those of the devices."""
    return np.diag([1.0, -1.0, -1.0])


def first_pair(
    rays: Float64[ndarray, "frames cells 3"], cameras: Sequence[Device], settings: ChainSettings
) -> tuple[int, int, Float64[ndarray, "4 4"]] | None:
    """Two cameras with many matches and a large angle between them, and the pose of the second against the first."""
    seen = np.isfinite(rays[..., 0])
    common = seen.astype(np.float64) @ seen.T
    pairs = [(a, b) for a, b in combinations(range(len(rays)), 2) if common[a, b] >= settings.fewest]
    # spread over the whole set, not only neighbours, which share most and turn least
    pairs = (
        pairs
        if len(pairs) <= settings.pairs
        else [pairs[k] for k in np.linspace(0, len(pairs) - 1, settings.pairs).astype(int)]
    )
    best, best_score = None, 0.0
    for a, b in pairs:
        both = seen[a] & seen[b]
        found = _two_views(rays[a, both], rays[b, both], settings.outlier_px / cameras[a].fl_x)
        if found is None:
            continue
        T, good = found
        d_b = rays[b, both][good] @ T[:3, :3].T
        angle = np.degrees(np.arccos((rays[a, both][good] * d_b).sum(-1).clip(-1, 1)))
        score = good.sum() * min(float(np.median(angle)), settings.usable_angle_deg)
        if score > best_score:
            best, best_score = (a, b, T), score
    return best


def _two_views(
    d_a: Float64[ndarray, "n 3"], d_b: Float64[ndarray, "n 3"], threshold: float
) -> tuple[Float64[ndarray, "4 4"], Bool[ndarray, "n"]] | None:
    """T_a_b with baseline one, and the inliers."""
    a, b = image_points(d_a), image_points(d_b)
    E, mask = cv2.findEssentialMat(a, b, np.eye(3), cv2.RANSAC, 0.9999, threshold)
    if E is None or E.shape != (3, 3):
        return None
    count, R, t, mask = cv2.recoverPose(E, a, b, np.eye(3), mask=mask)
    if count < 8:
        return None
    T = pose_from_opencv(R, t[:, 0])
    # the first camera's own axes are the world's: from OpenCV's to the device's
    T[:3, :3], T[:3, 3] = _flip() @ T[:3, :3], _flip() @ T[:3, 3]
    return T, mask[:, 0] > 0


def triangulated(
    rays: Float64[ndarray, "frames cells 3"], T_world_camera: Float64[ndarray, "frames 4 4"], least_angle_deg: float
) -> Float64[ndarray, "cells 3"]:
    """Points nearest to the rays of all placed cameras; NaN where their angle is too small, or they lie behind."""
    placed = np.isfinite(T_world_camera[:, 0, 0])
    R, o = T_world_camera[placed, :3, :3], T_world_camera[placed, :3, 3]
    d = np.einsum("fij,fcj->fci", R, rays[placed])
    seen = np.isfinite(d[..., 0])
    d = np.nan_to_num(d)
    P = (np.eye(3) - d[..., :, None] * d[..., None, :]) * seen[..., None, None]
    A, b = P.sum(0), np.einsum("fcij,fj->ci", P, o)
    # the smallest eigenvalue of the sum is the sum of squared sines of half the angles, to first order
    small = np.linalg.eigvalsh(A)[:, 0]
    good = (seen.sum(0) > 1) & (small > 0.5 * np.sin(np.radians(least_angle_deg)) ** 2)
    points = np.full((rays.shape[1], 3), np.nan)
    points[good] = np.linalg.solve(A[good], b[good][..., None])[..., 0]
    along = np.einsum("fci,fci->fc", d, points[None] - o[:, None])
    behind = (seen & ~(along > 0)).any(0)
    points[behind] = np.nan
    return points


def place_next(
    k: int,
    rays: Float64[ndarray, "cells 3"],
    points: Float64[ndarray, "cells 3"],
    camera: Device,
    settings: ChainSettings,
) -> Float64[ndarray, "4 4"] | None:
    """Pose of a camera against known points (PnP with RANSAC); None where it has too few or no pose fits."""
    both = np.isfinite(rays[:, 0]) & np.isfinite(points[:, 0])
    if both.sum() < settings.fewest:
        return None
    return posed(points[both], rays[both], 3 * settings.outlier_px / camera.fl_x, 0.5)


def posed(
    points: Float64[ndarray, "n 3"], d: Float64[ndarray, "n 3"], threshold: float, least_share: float
) -> Float64[ndarray, "4 4"] | None:
    """T_world_device of a device that sees points along unit rays; None where no pose fits enough of them.

    `threshold`: distance in normalised coordinates within which a point fits.
    """
    ok, r, t, inliers = cv2.solvePnPRansac(
        points, image_points(d), np.eye(3), np.zeros(4), iterationsCount=500, reprojectionError=threshold,
        confidence=0.9999, flags=cv2.SOLVEPNP_SQPNP,
    )  # fmt: skip
    if not ok or inliers is None or len(inliers) < least_share * len(points):
        return None
    return pose_from_opencv(cv2.Rodrigues(r)[0], t[:, 0])
