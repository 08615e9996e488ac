"""All frames under a projector that stands still: cameras, then the projector, then everything together."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray
from scipy.linalg import rq
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project, project_jacobian
from sl_nerfstudio.geometry.numerics import MAD_TO_SIGMA, geman_mcclure_cost, geman_mcclure_weight
from sl_nerfstudio.parallel import one_library_thread
from sl_nerfstudio.relative_pose.epipolar import correspondences_of, directions
from sl_nerfstudio.relative_pose.joint_fit import (
    CX,
    CY,
    K1,
    LOG_ASPECT,
    LOG_FOCAL,
    PRIOR_SIGMA,
    device_with,
    values_of,
)

# Settings of the placement of cameras under a projector that stands still.


@dataclass(frozen=True)
class CellSettings:
    """Squares of the pattern at whose centres all cameras are compared."""

    pixels: float = 20.0
    """camera pixels in a square, in the mean"""
    most_along: int = 300
    """squares along the longer side of the pattern, at most"""
    fewest: int = 6
    """camera pixels from which a square is used"""
    roughness_medians: float = 3.0
    """distance of a square's pixels from a linear map, in medians of all squares, beyond which it lies at an edge"""
    largest_lever: float = 4.0
    """inverse share of pixels that determine the place of the centre: how far it may lie beside the pixels"""


@dataclass(frozen=True)
class ChainSettings:
    """Cameras placed one after the other."""

    fewest: int = 60
    """squares that two cameras, or a camera and the known points, must have in common"""
    pairs: int = 60
    """pairs of cameras that are tried as the first, at most"""
    outlier_px: float = 2.0
    """distance within which a match is an inlier, camera pixels"""
    usable_angle_deg: float = 15.0
    """angle between two cameras' rays beyond which more is no gain for a first pair"""
    least_angle_deg: float = 1.0
    """angle between rays from which a point counts as known"""


@dataclass(frozen=True)
class ResectionSettings:
    """The projector from points and their codes."""

    fewest: int = 20
    """points, at least"""
    rounds: int = 8
    """of leaving out what does not fit"""
    outlier_sigmas: float = 4.0
    """standard deviations beyond which a point is left out"""
    least_relief: float = 1e-3
    """extent of the points across their plane, as a share of that along it"""


@dataclass(frozen=True)
class StaticSettings:
    """All settings."""

    most_points: int = 2500
    """squares in the bundle adjustment, at most"""
    iterations: int = 40
    """Levenberg-Marquardt steps, at most"""
    kernel_sigmas: float = 3.0
    """width of the robust kernel, in standard deviations of the residuals"""
    noise_quantile: float = 0.8
    """share of the residuals whose size tells the noise: with lenses modelled less than perfectly, half is too few"""
    parts_along: int = 8
    """parts along the longer side of the pattern within which errors may depend on each other"""
    noise_floor_px: float = 1e-4
    """noise that is assumed at least, pixels"""
    converged: float = 1e-6
    """share of the cost that a step must gain for the search to go on"""
    standard_errors: float = 2.0
    """standard errors by which left-out squares must agree better for another free parameter"""
    folds: int = 4
    """parts that are left out in turn"""
    dependence: float = 2.0
    """factor on the stated sigma: neighbouring squares share errors of decoding and of the lens"""
    largest_sigma: float = 0.08
    """standard deviation of the focal length, as a share, beyond which there is no result"""
    largest_noise_share: float = 0.005
    """noise, as a share of the pattern's width, beyond which no single projector explains what the cameras see"""
    doubtful_sigma: float = 0.02
    """the same beyond which the result is doubtful"""
    cells: CellSettings = field(default_factory=CellSettings)
    """squares"""
    chain: ChainSettings = field(default_factory=ChainSettings)
    """placement of the cameras"""
    resection: ResectionSettings = field(default_factory=ResectionSettings)
    """the projector's first place"""
    difference_step: float = 1e-6
    """change of the intrinsics for derivatives"""


STATIC_DEFAULTS = StaticSettings()

# Where every camera sees the centres of small squares of the pattern: matches between all cameras at once.


@dataclass(frozen=True)
class PatternCells:
    """Centres of the squares that two cameras or more see."""

    uv_projector: Float64[ndarray, "cells 2"]
    uv_camera: Float64[ndarray, "frames cells 2"]  # NaN where a camera does not see it

    @property
    def seen(self) -> Bool[ndarray, "frames cells"]:
        """Which camera sees which square."""
        return np.isfinite(self.uv_camera[..., 0])

    def chosen(self, index: Int64[ndarray, "m"] | Bool[ndarray, "cells"]) -> "PatternCells":
        """Some of the squares."""
        return PatternCells(self.uv_projector[index], self.uv_camera[:, index])


def find_cells(coords: Sequence[Float32[ndarray, "_ _ 2"]], projector: Device, settings: CellSettings) -> PatternCells:
    """Squares of equal size; in each, a linear map from coordinates to pixels gives the place of the centre."""
    matches = [correspondences_of(uv) for uv in coords]
    side = _side(matches, projector, settings)
    columns, rows = int(np.ceil(projector.w / side)), int(np.ceil(projector.h / side))
    number = np.arange(columns * rows)
    centres = (np.stack([number % columns, number // columns], -1) + 0.5) * side
    seen = np.stack([_centres_seen(*match, centres, side, columns, rows, settings) for match in matches])
    used = np.isfinite(seen[..., 0]).sum(0) > 1
    return PatternCells(centres[used], seen[:, used])


def _side(matches: Sequence[tuple[ndarray, ndarray]], projector: Device, settings: CellSettings) -> float:
    """Side of the squares, so that they hold enough camera pixels in most frames."""
    least = max(projector.w, projector.h) / settings.most_along
    density = []
    for _, uv in matches:
        if len(uv):
            column, row = np.floor(uv / (4 * least)).astype(np.int64).clip(0, 4 * settings.most_along).T
            squares = np.count_nonzero(np.bincount(row * (4 * settings.most_along + 1) + column))
            density.append(len(uv) / (squares * 16 * least**2))
    return max(least, float(np.sqrt(settings.pixels / np.median(density)))) if density else least


def _centres_seen(
    uv_camera: Float64[ndarray, "n 2"],
    uv_projector: Float64[ndarray, "n 2"],
    centres: Float64[ndarray, "cells 2"],
    side: float,
    columns: int,
    rows: int,
    settings: CellSettings,
) -> Float64[ndarray, "cells 2"]:
    """Least squares in every square at once, from sums over its pixels."""
    column, row = np.floor(uv_projector / side).astype(np.int64).T
    inside = (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
    cell = (row * columns + column)[inside]
    away = (uv_projector[inside] - centres[cell]) / side
    basis = np.concatenate([np.ones((len(away), 1)), away], 1)
    uv = uv_camera[inside]
    count = np.bincount(cell, minlength=len(centres))
    middle = _sums(cell, uv, len(centres)) / count.clip(1)[:, None]
    from_middle = uv - middle[cell]
    A = _sums(cell, basis[:, :, None] * basis[:, None, :], len(centres))
    b = _sums(cell, basis[:, :, None] * from_middle[:, None, :], len(centres))
    squares = _sums(cell, from_middle**2, len(centres))
    out = np.full((len(centres), 2), np.nan)
    good = (count >= settings.fewest) & (np.linalg.det(A) > 1e-6 * count.astype(float) ** 3)
    if not good.any():
        return out
    inverse = np.linalg.inv(A[good])
    linear = inverse @ b[good]
    left = (squares[good] - (linear * b[good]).sum(1)).clip(0).sum(1) / (2 * count[good])
    rough = np.sqrt(left)
    lever = inverse[:, 0, 0] * count[good]  # 1 if the pixels lie around the centre, larger if they lie beside it
    firm = (rough <= settings.roughness_medians * max(float(np.median(rough)), 1e-9)) & (lever < settings.largest_lever)
    index = np.flatnonzero(good)[firm]
    out[index] = middle[index] + linear[firm, 0]
    return out


def _sums(cell: Int64[ndarray, "n"], values: Float64[ndarray, "n *k"], cells: int) -> Float64[ndarray, "cells *k"]:
    """Sums of values over the pixels of each square."""
    flat = values.reshape(len(values), -1)
    columns = [np.bincount(cell, flat[:, k], minlength=cells) for k in range(flat.shape[1])]
    return np.stack(columns, 1).reshape(cells, *values.shape[1:])


# Cameras placed by the codes alone: two views first, then one camera after the other against the known points.
#
# Normalised coordinates are OpenCV's here (y down, looking along +z); poses are those of the devices (looking along
# -z).


def rays_of(cells: PatternCells, cameras: Sequence[Device]) -> Float64[ndarray, "frames cells 3"]:
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


# The projector from points in space and their coordinates: resection by the direct linear transform.


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


# Bundle adjustment of cameras, one projector and points; points are eliminated (Schur complement).
#
# The projector is one more device, whose intrinsics may be free. Residuals are pixels of each device, divided by
# the
# noise of its kind. Increments: `T_world_device <- T_world_device exp(v, w)`.


@dataclass(frozen=True)
class StaticScene:
    """What is adjusted: devices (the projector, if there is one, is the last), their poses, and points."""

    devices: tuple[Device, ...]
    T_world_device: Float64[ndarray, "devices 4 4"]
    points: Float64[ndarray, "points 3"]


@dataclass(frozen=True)
class CellSightings:
    """Where devices see points."""

    device: Int64[ndarray, "n"]
    point: Int64[ndarray, "n"]
    uv: Float64[ndarray, "n 2"]
    cameras: int  # devices from this number on are projectors


@dataclass(frozen=True)
class AdjustedScene:
    """The scene where the robust cost is smallest."""

    scene: StaticScene
    noise_px: float  # of one coordinate, pixels of all devices
    covariance: Float64[ndarray, "free free"]  # of the projector's free intrinsics


def adjust_scene(
    scene: StaticScene, sightings: CellSightings, free: tuple[int, ...], settings: StaticSettings
) -> AdjustedScene:
    """Levenberg-Marquardt from a start that is right to within a few pixels."""
    damping, cost, width = 1e-4, np.inf, np.inf
    prior = _Prior.of(scene.devices[-1], free, settings)
    for _ in range(settings.iterations):
        r = residuals(scene, sightings)
        width = min(width, settings.kernel_sigmas * _noise(r, scene, settings))
        cost = _cost(r, sightings, width, prior, scene)
        equations = _equations(scene, sightings, r, width, free, prior)
        for _ in range(8):
            new = _stepped(scene, equations, damping, free)
            new_cost = _cost(residuals(new, sightings), sightings, width, prior, new)
            if new_cost <= cost:
                damping = max(damping / 10, 1e-10)
                break
            damping *= 10
        else:
            break
        scene, gain = new, cost - new_cost
        if gain <= settings.converged * cost:
            break
    r = residuals(scene, sightings)
    noise = _noise(r, scene, settings)
    equations = _equations(scene, sightings, r, settings.kernel_sigmas * noise, free, prior)
    return AdjustedScene(scene, noise, _covariance(equations, sightings, scene, len(free), settings))


@dataclass(frozen=True)
class _Prior:
    mean: Float64[ndarray, "5"]
    sigma: Float64[ndarray, "5"]
    free: tuple[int, ...]
    difference_step: float

    @staticmethod
    def of(projector: Device, free: tuple[int, ...], settings: StaticSettings) -> "_Prior":
        return _Prior(values_of(projector), PRIOR_SIGMA, free, settings.difference_step)

    def departure(self, scene: StaticScene) -> Float64[ndarray, "free"]:
        index = list(self.free)
        return (values_of(scene.devices[-1]) - self.mean)[index] / self.sigma[index]


@dataclass(frozen=True)
class _Equations:
    """Normal equations in units of the noise: devices and intrinsics, points, and what couples them."""

    H: Float64[ndarray, "m m"]
    g: Float64[ndarray, "m"]
    points_H: Float64[ndarray, "points 3 3"]
    points_g: Float64[ndarray, "points 3"]
    gradients: Float64[ndarray, "m points"]  # what each point adds to g
    coupling: Float64[ndarray, "m points*3"]


def _in_devices(scene: StaticScene, s: CellSightings) -> Float64[ndarray, "n 3"]:
    T = scene.T_world_device[s.device]
    return np.einsum("nji,nj->ni", T[:, :3, :3], scene.points[s.point] - T[:, :3, 3])


def _intrinsics(devices: Sequence[Device], s: CellSightings) -> list[tuple[Intrinsics, ndarray]]:
    """Devices that share intrinsics are projected together."""
    groups: dict[Device, list[int]] = {}
    for k, device in enumerate(devices):
        groups.setdefault(device, []).append(k)
    return [
        (Intrinsics.of(device, torch.float64), np.flatnonzero(np.isin(s.device, index)))
        for device, index in groups.items()
    ]


def residuals(scene: StaticScene, s: CellSightings) -> Float64[ndarray, "n 2"]:
    """Pixels by which devices see the points elsewhere than they should; far off where a point is behind."""
    p, out = _in_devices(scene, s), np.zeros((len(s.device), 2))
    for intrinsics, rows in _intrinsics(scene.devices, s):
        uv, front = project(intrinsics, torch.from_numpy(p[rows]))
        out[rows] = np.where(front.numpy()[:, None], uv.numpy() - s.uv[rows], 1e6)
    return out


def _noise(r: Float64[ndarray, "n 2"], scene: StaticScene, settings: StaticSettings) -> float:
    """Robust standard deviation of one coordinate, of all devices together.

    Apart, that of the cameras or that of the projector could fall to nothing, because three numbers of every point are
    free. Those are allowed for.
    """
    free = 3 * len(scene.points)
    lost = np.sqrt(r.size / max(r.size - free, 1))
    size = float(np.quantile(np.abs(r), settings.noise_quantile))
    return max(lost * size / float(norm.ppf((1 + settings.noise_quantile) / 2)), settings.noise_floor_px)


def _cost(r: Float64[ndarray, "n 2"], s: CellSightings, width: float, prior: _Prior, scene: StaticScene) -> float:
    data = 9 * float(geman_mcclure_cost((r**2).sum(-1) / width**2).sum())
    return data + float((prior.departure(scene) ** 2).sum())


def _equations(
    scene: StaticScene,
    s: CellSightings,
    r: Float64[ndarray, "n 2"],
    width: float,
    free: tuple[int, ...],
    prior: _Prior,
) -> _Equations:
    p, n = _in_devices(scene, s), len(s.device)
    by_p = np.zeros((n, 2, 3))
    for intrinsics, rows in _intrinsics(scene.devices, s):
        by_p[rows] = project_jacobian(intrinsics, torch.from_numpy(p[rows])).numpy()
    x, y, z, o = *p.T, np.zeros(n)
    hat = np.stack([o, -z, y, z, o, -x, -y, x, o], -1).reshape(n, 3, 3)
    by_pose = np.concatenate([-by_p, by_p @ hat], -1)
    by_point = by_p @ scene.T_world_device[s.device, :3, :3].transpose(0, 2, 1)
    w = geman_mcclure_weight((r**2).sum(-1) / width**2) / (width / 3) ** 2
    D, C, m = len(scene.devices), len(scene.points), 6 * len(scene.devices) + len(free)
    columns = np.broadcast_to(6 * s.device[:, None] + np.arange(6), (n, 6))
    J = by_pose
    if free:
        by_free = np.zeros((n, 2, len(free)))
        rows = np.flatnonzero(s.device == D - 1)
        by_free[rows] = _by_intrinsics(scene.devices[-1], p[rows], free, prior.difference_step)
        J = np.concatenate([J, by_free], -1)
        columns = np.concatenate([columns, np.broadcast_to(6 * D + np.arange(len(free)), (n, len(free)))], 1)
    H, gradients, coupling = np.zeros((m, m)), np.zeros((m, C)), np.zeros((m, 3 * C))
    JtW = J.transpose(0, 2, 1) * w[:, None, None]
    np.add.at(H, (columns[:, :, None], columns[:, None, :]), JtW @ J)
    np.add.at(gradients, (columns, s.point[:, None]), (JtW @ r[..., None])[..., 0])
    at = 3 * s.point[:, None] + np.arange(3)
    np.add.at(coupling, (columns[:, :, None], at[:, None, :]), JtW @ by_point)
    points_H, points_g = np.zeros((C, 3, 3)), np.zeros((C, 3))
    PtW = by_point.transpose(0, 2, 1) * w[:, None, None]
    np.add.at(points_H, s.point, PtW @ by_point)
    np.add.at(points_g, s.point, (PtW @ r[..., None])[..., 0])
    index, k = 6 * D + np.arange(len(free)), list(free)
    H[index, index] += 1 / prior.sigma[k] ** 2
    g = gradients.sum(1)
    g[index] += prior.departure(scene) / prior.sigma[k]
    return _Equations(H, g, points_H, points_g, gradients, coupling)


def _by_intrinsics(
    projector: Device, p: Float64[ndarray, "n 3"], free: tuple[int, ...], step: float
) -> Float64[ndarray, "n 2 free"]:
    values, out = values_of(projector), []
    for k in free:
        ahead, behind = (
            project(
                Intrinsics.of(device_with(projector, values + sign * step * np.eye(len(values))[k]), torch.float64),
                torch.from_numpy(p),
            )[0].numpy()
            for sign in (1, -1)
        )
        out.append((ahead - behind) / (2 * step))
    return np.stack(out, -1)


def _reduced(e: _Equations, damping: float) -> tuple[ndarray, ndarray, ndarray]:
    """Equations of the devices with points eliminated, and the inverses of the points' blocks."""
    blocks = (
        e.points_H
        + damping * e.points_H * np.eye(3)
        + 1e-12 * np.eye(3) * e.points_H.trace(axis1=1, axis2=2)[:, None, None]
    )
    inverse = np.linalg.inv(np.where(blocks.any((1, 2))[:, None, None], blocks, np.eye(3)))
    m = len(e.H)
    by_point = e.coupling.reshape(m, -1, 3)
    carried = np.einsum("mci,cij->mcj", by_point, inverse).reshape(m, -1)
    S = e.H - carried @ e.coupling.T
    return (S + S.T) / 2, e.g - carried @ e.points_g.reshape(-1), inverse


def _covariance(
    e: _Equations, s: CellSightings, scene: StaticScene, free: int, settings: StaticSettings
) -> Float64[ndarray, "free free"]:
    """Of the projector's intrinsics, cluster-robust: errors of points in one part of the pattern may be shared.

    Lenses that are modelled slightly wrong, and edges that are decoded wrong, push neighbouring points the same way.
    """
    if not free:
        return np.zeros((0, 0))
    S, _, inverse = _reduced(e, 0.0)
    m, C = len(S), len(scene.points)
    H_inverse = np.linalg.pinv(S, rcond=1e-13, hermitian=True)
    pull = np.einsum("mci,cij,cj->mc", e.coupling.reshape(m, C, 3), inverse, e.points_g)
    part = _parts(s, scene, settings.parts_along)
    scores = np.stack([np.bincount(part, row) for row in e.gradients - pull], 1)
    n = len(scores)
    meat = scores.T @ scores * (n / max(n - m, n / 4))
    formal, robust = (matrix[m - free :, m - free :] for matrix in (H_inverse, H_inverse @ meat @ H_inverse))
    growth = np.sqrt(np.maximum(np.diag(robust) / np.diag(formal), 1.0))
    return growth[:, None] * formal * growth


def _parts(s: CellSightings, scene: StaticScene, along: int) -> Int64[ndarray, "points"]:
    """Number of the square part of the projector's image in which each point lies; one part without a projector."""
    part = np.zeros(len(scene.points), dtype=np.int64)
    beam = s.device >= s.cameras
    uv = s.uv[beam]
    if len(uv):
        low, high = uv.min(0), uv.max(0)
        cell = ((uv - low) / (high - low).max() * along).astype(np.int64).clip(0, along - 1)
        part[s.point[beam]] = cell[:, 1] * along + cell[:, 0]
    return part


def _stepped(scene: StaticScene, e: _Equations, damping: float, free: tuple[int, ...]) -> StaticScene:
    S, g, inverse = _reduced(e, damping)
    S = S + damping * np.diag(np.diag(e.H)) + 1e-12 * np.trace(S) / len(S) * np.eye(len(S))
    step = -np.linalg.solve(S, g)
    D, C = len(scene.devices), len(scene.points)
    pull = e.points_g + (e.coupling.T @ step).reshape(C, 3)
    points = scene.points - np.einsum("cij,cj->ci", inverse, pull)
    T = scene.T_world_device.copy()
    v, w = step[: 6 * D].reshape(D, 6)[:, :3], step[: 6 * D].reshape(D, 6)[:, 3:]
    T[:, :3, 3] += np.einsum("dij,dj->di", T[:, :3, :3], v)
    T[:, :3, :3] = T[:, :3, :3] @ Rotation.from_rotvec(w).as_matrix()
    devices = scene.devices
    if free:
        values = values_of(devices[-1])
        values[list(free)] += step[6 * D :].clip(-0.3, 0.3)
        devices = (*devices[:-1], device_with(devices[-1], values))
    return replace(scene, devices=devices, T_world_device=T, points=points)


Fault = Literal["no pair", "no projector", "uncertain"]
_MODELS = (
    (LOG_FOCAL, CX, CY),
    (LOG_FOCAL, CX, CY, K1),
    (LOG_FOCAL, LOG_ASPECT, CX, CY),
    (LOG_FOCAL, LOG_ASPECT, CX, CY, K1),
)


@dataclass(frozen=True)
class StaticPlacement:
    """Poses in one world; the baseline of the first two cameras' pair is about one."""

    T_world_camera: Float64[ndarray, "frames 4 4"]  # NaN where a camera could not be placed
    projector: Device
    T_world_projector: Float64[ndarray, "4 4"]
    covariance: Float64[ndarray, "5 5"]  # of the projector's `joint_fit.NAMES`; zero where not free
    noise_px: float  # robust standard deviation of one coordinate, pixels of all devices


@dataclass(frozen=True)
class NoPlacement:
    """What could not be found."""

    fault: Fault
    common: int  # squares that the best two cameras have in common
    sigma_focal: float = np.inf  # share of the focal length


@one_library_thread()
def place_under_static_projector(
    coords: Sequence[Float32[ndarray, "_ _ 2"]],
    cameras: Sequence[Device],
    projector: Device,
    known: bool,
    stated: bool,
    settings: StaticSettings = STATIC_DEFAULTS,
) -> StaticPlacement | NoPlacement:
    """Camera poses from the codes as matches; the projector's intrinsics too, unless they are `known`.

    `stated`: the projector is at least a start for them.
    """
    cells = find_cells(coords, projector, settings.cells)
    rays = rays_of(cells, cameras)
    common = np.isfinite(rays[..., 0]).astype(np.float64)
    most = int((common @ common.T - np.diag(common.sum(1))).max(initial=0)) if len(rays) > 1 else 0
    start = first_pair(rays, cameras, settings.chain)
    if start is None:
        return NoPlacement("no pair", most)
    a, b, T_a_b = start
    T = np.full((len(cameras), 4, 4), np.nan)
    T[a], T[b] = np.eye(4), T_a_b
    T = _grown(T, rays, cells, cameras, settings)
    points = triangulated(rays, T, settings.chain.least_angle_deg)
    firm = _spread(np.isfinite(points[:, 0]), settings.most_points)
    found = _projector(points[firm], cells.uv_projector[firm], projector, known, stated, settings)
    if found is None:
        return NoPlacement("no projector", most)
    device, T_projector = found
    placed = np.flatnonzero(np.isfinite(T[:, 0, 0]))
    scene = StaticScene(
        (*(cameras[k] for k in placed), device), np.concatenate([T[placed], T_projector[None]]), points[firm]
    )
    sightings = _sightings(cells.chosen(firm), placed, with_projector=True)
    adjusted, free = _best_model(scene, sightings, known, projector.model == "DOE", settings)
    if adjusted.noise_px > settings.largest_noise_share * projector.w:
        return NoPlacement("no projector", most)
    T[placed] = adjusted.scene.T_world_device[:-1]
    covariance = np.zeros((5, 5))
    covariance[np.ix_(free, free)] = settings.dependence**2 * adjusted.covariance
    sigma = float(np.sqrt(covariance[LOG_FOCAL, LOG_FOCAL]))
    if sigma > settings.largest_sigma:
        return NoPlacement("uncertain", most, sigma)
    return StaticPlacement(
        T, adjusted.scene.devices[-1], adjusted.scene.T_world_device[-1], covariance, adjusted.noise_px
    )


def _grown(
    T: Float64[ndarray, "frames 4 4"],
    rays: Float64[ndarray, "frames cells 3"],
    cells: PatternCells,
    cameras: Sequence[Device],
    settings: StaticSettings,
) -> Float64[ndarray, "frames 4 4"]:
    """Cameras added one by one, those that see most known points first; everything is adjusted as the set doubles."""
    T, failed, adjusted_with = T.copy(), set(), 0
    while True:
        placed = np.isfinite(T[:, 0, 0])
        if placed.sum() >= 2 * adjusted_with or placed.all():
            T = _adjusted_cameras(T, rays, cells, cameras, settings)
            adjusted_with = int(placed.sum())
        points = triangulated(rays, T, settings.chain.least_angle_deg)
        seen = (np.isfinite(rays[..., 0]) & np.isfinite(points[:, 0])).sum(1)
        left = sorted((int(k) for k in np.flatnonzero(~placed) if k not in failed), key=lambda k: -seen[k])
        if not left:
            return T if placed.sum() == adjusted_with else _adjusted_cameras(T, rays, cells, cameras, settings)
        pose = place_next(left[0], rays[left[0]], points, cameras[left[0]], settings.chain)
        if pose is None:
            failed.add(left[0])
        else:
            T[left[0]] = pose
            failed.clear()


def _adjusted_cameras(
    T: Float64[ndarray, "frames 4 4"],
    rays: Float64[ndarray, "frames cells 3"],
    cells: PatternCells,
    cameras: Sequence[Device],
    settings: StaticSettings,
) -> Float64[ndarray, "frames 4 4"]:
    """The placed cameras adjusted with the points that they see, without a projector."""
    placed = np.flatnonzero(np.isfinite(T[:, 0, 0]))
    points = triangulated(rays, T, settings.chain.least_angle_deg)
    firm = _spread(np.isfinite(points[:, 0]), settings.most_points)
    scene = StaticScene(tuple(cameras[k] for k in placed), T[placed], points[firm])
    found = adjust_scene(scene, _sightings(cells.chosen(firm), placed, with_projector=False), (), settings).scene
    T = T.copy()
    T[placed] = found.T_world_device
    return T


def _spread(good: Bool[ndarray, "cells"], most: int) -> Int64[ndarray, "m"]:
    """At most `most` of the good cells, evenly among them."""
    index = np.flatnonzero(good)
    return index if len(index) <= most else index[np.linspace(0, len(index) - 1, most).astype(np.int64)]


def _sightings(cells: PatternCells, placed: Int64[ndarray, "m"], *, with_projector: bool) -> CellSightings:
    frame, cell = np.nonzero(cells.seen[placed])
    uv = cells.uv_camera[placed][frame, cell]
    if with_projector:
        every = np.arange(len(cells.uv_projector))
        frame = np.concatenate([frame, np.full(len(every), len(placed))])
        cell, uv = np.concatenate([cell, every]), np.concatenate([uv, cells.uv_projector])
    return CellSightings(frame, cell, uv, len(placed))


def _projector(
    points: Float64[ndarray, "n 3"],
    uv: Float64[ndarray, "n 2"],
    projector: Device,
    known: bool,
    stated: bool,
    settings: StaticSettings,
) -> tuple[Device, Float64[ndarray, "4 4"]] | None:
    """Intrinsics and pose to start from."""
    if known or projector.model == "DOE":
        T = place_known(points, uv, projector)
        return None if T is None else (projector, T)
    found = resect(points, uv, projector, settings.resection)
    if found is None and stated:
        T = place_known(points, uv, projector)
        return None if T is None else (projector, T)
    return found


def _best_model(
    scene: StaticScene, sightings: CellSightings, known: bool, doe: bool, settings: StaticSettings
) -> tuple[AdjustedScene, tuple[int, ...]]:
    """The smallest model that no larger one beats on left-out points by more than chance."""
    if known:
        return adjust_scene(scene, sightings, (), settings), ()
    models = _MODELS[:1] if doe else _MODELS
    best = adjust_scene(scene, sightings, models[0], settings)
    chosen, best_loss = models[0], None
    for model in models[1:]:
        larger = adjust_scene(_restarted(best.scene, scene, model), sightings, model, settings)
        extra = [k for k in model if k not in models[0]]
        away = np.abs(_further(larger.scene.devices[-1], extra) - _further(scene.devices[-1], extra))
        sigma = np.sqrt(np.diag(larger.covariance))[[model.index(k) for k in extra]]
        if (away < settings.standard_errors * settings.dependence * sigma).any():
            continue  # what does not differ from its usual value by more than chance cannot help
        base = _left_out(best.scene, sightings, chosen, settings) if best_loss is None else best_loss
        loss = _left_out(larger.scene, sightings, model, settings)
        gain = base - loss
        if gain.sum() > settings.standard_errors * np.sqrt((gain**2).sum()):
            best, chosen, best_loss = larger, model, loss
    return best, chosen


def _restarted(found: StaticScene, start: StaticScene, free: tuple[int, ...]) -> StaticScene:
    """The scene that was found, with the projector's intrinsics as in the start where they are not free."""
    values = values_of(start.devices[-1])
    values[list(free)] = values_of(found.devices[-1])[list(free)]
    return replace(found, devices=(*found.devices[:-1], device_with(start.devices[-1], values)))


def _further(device: Device, names: Sequence[int]) -> Float64[ndarray, "m"]:
    values = {LOG_ASPECT: np.log(device.fl_y / device.fl_x), K1: device.k1}
    return np.array([values[k] for k in names])


def _left_out(
    scene: StaticScene, sightings: CellSightings, free: tuple[int, ...], settings: StaticSettings
) -> Float64[ndarray, "points"]:
    """Error of the projector's view of every point (capped), when its coordinate takes no part in the fit."""
    out = np.zeros(len(scene.points))
    projector = sightings.device == sightings.cameras
    short = replace(settings, iterations=5)
    for fold in range(settings.folds):
        left = projector & (sightings.point % settings.folds == fold)
        kept = CellSightings(sightings.device[~left], sightings.point[~left], sightings.uv[~left], sightings.cameras)
        found = adjust_scene(scene, kept, free, short)
        loss = view_error(found.scene, sightings, left, settings.kernel_sigmas * found.noise_px)
        out[sightings.point[left]] = loss
    return out


def view_error(
    scene: StaticScene, sightings: CellSightings, rows: Bool[ndarray, "n"], width: float
) -> Float64[ndarray, "m"]:
    """Robust cost of some sightings, 0 to 1."""
    r = residuals(
        scene, CellSightings(sightings.device[rows], sightings.point[rows], sightings.uv[rows], sightings.cameras)
    )
    x = (r**2).sum(-1) / width**2
    return x / (1 + x)
