"""The projector from points in space and their coordinates: resection by the direct linear transform."""

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray
from scipy.linalg import rq

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.robust import MAD_TO_SIGMA
from sl_nerfstudio.registration.static_projector.chain import pose_from_opencv, posed
from sl_nerfstudio.registration.static_projector.settings import STATIC_DEFAULTS, ResectionSettings
from sl_nerfstudio.relative_pose.ray_pairs import directions
from sl_nerfstudio.relative_pose.unknown_projector.parameters import device_with


def resect(
    points: Float64[ndarray, "n 3"],
    uv: Float64[ndarray, "n 2"],
    projector: Device,
    settings: ResectionSettings = STATIC_DEFAULTS.resection,
) -> tuple[Device, Float64[ndarray, "4 4"]] | None:
    """Focal length, principal point (anywhere) and pose of a pinhole projector; its pixels count as square.

    None where the points lie in a plane, or no projector fits.
    """
    extent = np.linalg.svd(points - points.mean(0), compute_uv=False)
    if len(points) < settings.fewest or extent[2] < settings.least_relief * extent[1]:
        return None
    keep = np.ones(len(points), dtype=bool)
    P = None
    for _ in range(settings.rounds):
        if keep.sum() < settings.fewest:
            return None
        P = _linear(points[keep], uv[keep])
        error = np.linalg.norm(_seen(P, points) - uv, axis=1)
        limit = settings.outlier_sigmas * MAD_TO_SIGMA * float(np.median(error))
        again: Bool[ndarray, n] = error <= max(limit, 1e-9)
        if (again == keep).all():
            break
        keep = again
    return None if P is None else _device_of(P, points[keep], projector)


def _linear(points: Float64[ndarray, "n 3"], uv: Float64[ndarray, "n 2"]) -> Float64[ndarray, "3 4"]:
    """The 3 x 4 matrix with the smallest algebraic error, from normalised points (Hartley, PAMI 1997)."""
    U, V = _normalising(points), _normalising(uv)
    X = np.concatenate([points, np.ones((len(points), 1))], 1) @ U.T
    x = np.concatenate([uv, np.ones((len(uv), 1))], 1) @ V.T
    A = np.zeros((2 * len(X), 12))
    A[::2, :4], A[::2, 8:] = X, -x[:, :1] * X
    A[1::2, 4:8], A[1::2, 8:] = X, -x[:, 1:2] * X
    P = np.linalg.svd(A.T @ A)[2][-1].reshape(3, 4)
    return np.linalg.inv(V) @ P @ U


def _normalising(points: Float64[ndarray, "n d"]) -> Float64[ndarray, "e e"]:
    """The similarity that moves points to the origin, at a mean distance of one."""
    middle = np.median(points, 0)
    size = float(np.median(np.linalg.norm(points - middle, axis=1)))
    T = np.eye(points.shape[1] + 1)
    T[:-1, :-1] /= size
    T[:-1, -1] = -middle / size
    return T


def _seen(P: Float64[ndarray, "3 4"], points: Float64[ndarray, "n 3"]) -> Float64[ndarray, "n 2"]:
    x = points @ P[:, :3].T + P[:, 3]
    return x[:, :2] / x[:, 2:]


def _device_of(
    P: Float64[ndarray, "3 4"], points: Float64[ndarray, "n 3"], projector: Device
) -> tuple[Device, Float64[ndarray, "4 4"]] | None:
    if np.linalg.det(P[:, :3]) < 0:
        P = -P
    K, R = rq(P[:, :3])
    signs = np.diag(np.sign(np.diag(K)))
    K, R = K @ signs, signs @ R
    if np.linalg.det(R) < 0 or not np.isfinite(K).all() or K[2, 2] == 0:
        return None
    t = np.linalg.solve(K, P[:, 3])
    if np.median(points @ R[2] + t[2]) < 0:
        return None  # the image is mirrored
    K = K / K[2, 2]
    focal = float(np.sqrt(K[0, 0] * K[1, 1]))
    w = projector.w
    device = device_with(projector, [np.log(focal), 0.0, K[0, 2] / w, K[1, 2] / w, projector.k1])
    return device, pose_from_opencv(R, t)


def place_known(
    points: Float64[ndarray, "n 3"],
    uv: Float64[ndarray, "n 2"],
    projector: Device,
    settings: ResectionSettings = STATIC_DEFAULTS.resection,
) -> Float64[ndarray, "4 4"] | None:
    """Pose of a projector with known intrinsics; None where no pose fits most of the points."""
    d = directions(projector, uv)
    usable = np.isfinite(d[:, 0]) & (d[:, 2] < -1e-3)
    if usable.sum() < 20:
        return None
    return posed(points[usable], d[usable], 6.0 / projector.fl_x, 0.3)
