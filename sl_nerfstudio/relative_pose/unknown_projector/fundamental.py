"""Fundamental matrices, and the intrinsics of the projector that make essential matrices of them.

Rays of the camera are points (x / z, y / z, 1) in its own axes, where both devices look along -z; `F` satisfies
`d_camera^T F (u, v, 1) = 0`. `F K` is an essential matrix with the right K: its two singular values are equal (Kruppa's
equations, one camera known: Hartley, Extraction of focal lengths from the fundamental matrix, 1993).
"""

from collections.abc import Sequence
from itertools import product

import cv2
import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.relative_pose.five_point import in_front
from sl_nerfstudio.relative_pose.ray_pairs import RayPairs
from sl_nerfstudio.relative_pose.unknown_projector.matches import Matches, UnitPose
from sl_nerfstudio.relative_pose.unknown_projector.settings import FundamentalSettings, GridSettings


def fundamental_matrix(
    matches: Matches, k: int, projector: Device, settings: FundamentalSettings
) -> Float64[ndarray, "3 3"] | None:
    """The fundamental matrix of frame `k`, in units of the projector's width; None where there is none."""
    part = matches.of_frame(k)
    d, uv = matches.d_camera[part][: settings.most], matches.uv_projector[part][: settings.most]
    if len(d) < settings.fewest:
        return None
    scale = projector.w  # so that both images are of similar size for the distance of outliers
    camera = d[:, :2] / d[:, 2:]
    spread = scale * float(np.ptp(uv, axis=0).max() / scale) / max(float(np.ptp(camera, axis=0).max()), 1e-9)
    F, _ = cv2.findFundamentalMat(uv, spread * camera, cv2.USAC_MAGSAC, settings.outlier_px, 0.9999, settings.samples)
    if F is None or F.shape != (3, 3):
        return None
    return np.diag([spread, spread, 1.0]) @ F @ np.diag([scale, scale, 1.0])


def calibration_matrix(device: Device) -> Float64[ndarray, "3 3"]:
    """From (x / z, y / z, 1) in the device's axes to pixels in units of the image's width."""
    w = device.w
    return np.array([[-device.fl_x / w, 0, device.cx / w], [0, device.fl_y / w, device.cy / w], [0, 0, 1.0]])


def grid_starts(
    F: Sequence[Float64[ndarray, "3 3"]], projector: Device, settings: GridSettings
) -> list[tuple[float, float, float]]:
    """Focal length and principal point in widths, the most promising first: places of the grid, apart from each other.

    The misfit of a frame is the relative difference of the two singular values, at most that of an outlier.
    """
    heights = projector.h / projector.w
    places = np.array(
        [(f, x, y * heights) for f, x, y in product(settings.focal_widths, settings.centre_x, settings.centre_y)]
    )
    K = np.zeros((len(places), 3, 3))
    K[:, 0, 0], K[:, 1, 1], K[:, 2, 2] = -places[:, 0], places[:, 0], 1
    K[:, 0, 2], K[:, 1, 2] = places[:, 1], places[:, 2]
    misfit = np.zeros(len(places))
    for one in F:
        s = np.linalg.svd(one @ K, compute_uv=False)
        misfit += np.minimum((1 - s[:, 1] / s[:, 0]) / settings.largest_misfit, 1) ** 2
    kept: list[tuple[float, float, float]] = []
    for place in places[np.argsort(misfit, kind="stable")]:
        if all(_apart(place, other, settings.apart) for other in kept):
            kept.append((float(place[0]), float(place[1]), float(place[2])))
        if len(kept) >= settings.starts:
            break
    return kept


def _apart(a: Sequence[float] | ndarray, b: Sequence[float] | ndarray, least: float) -> bool:
    return bool(max(abs(np.log(a[0] / b[0])), abs(a[1] - b[1]), abs(a[2] - b[2])) > least)


def pose_of_fundamental(F: Float64[ndarray, "3 3"], projector: Device, rays: RayPairs) -> UnitPose:
    """The pose nearest to a fundamental matrix with most rays meeting in front of both devices."""
    R1, R2, t = cv2.decomposeEssentialMat(F @ calibration_matrix(projector))
    poses = [(R, s * t[:, 0] / np.linalg.norm(t)) for R in (R1, R2) for s in (1.0, -1.0)]
    return max(poses, key=lambda pose: int(in_front(*pose, rays).sum()))
