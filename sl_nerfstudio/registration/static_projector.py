"""Placement of frames under a projector that stands still: cameras, then the projector, then everything together."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray
from scipy.linalg import rq
from scipy.spatial.transform import Rotation
from scipy.special import ndtri

from sl_nerfstudio.geometry.devices import Y_Z_DOWN, Device, Intrinsics, project, project_jacobian
from sl_nerfstudio.geometry.least_squares import BlockEquations, minimise
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
    with_larger_variances,
)
from sl_nerfstudio.relative_pose.unknown_projector import LARGEST_SIGMA

# Squares of the pattern at whose centres all cameras are compared.
CELL_PIXELS = 20.0  # camera pixels in a square, in the mean
MOST_ALONG = 300  # squares along the longer side of the pattern
FEWEST_IN_CELL = 6  # camera pixels from which a square is used
ROUGHNESS_MEDIANS = 3.0  # distance of its pixels from a linear map, in medians of all, beyond which it lies at an edge
LARGEST_LEVER = 4.0  # inverse share of pixels that determine the place of the centre: allowed extrapolation

# Cameras one after the other.
FEWEST_COMMON = 60  # squares that two cameras, or a camera and the known points, must have in common
MOST_FIRST_PAIRS = 60  # pairs of cameras that are tried as the first
OUTLIER_PX = 2.0  # distance within which a match is an inlier, camera pixels
USABLE_ANGLE_DEG = 15.0  # between two cameras' rays, beyond which more is no gain for a first pair
LEAST_ANGLE_DEG = 1.0  # between rays from which a point counts as known

# The projector from points and their codes.
FEWEST_POINTS = 20
RESECTION_ROUNDS = 8  # of leaving out what does not fit
OUTLIER_SIGMAS = 4.0  # standard deviations beyond which a point is left out
LEAST_RELIEF = 1e-3  # extent of the points across their plane, as a share of that along it

# Everything together.
MOST_POINTS = 2500  # squares in the adjustment
ITERATIONS = 40  # Levenberg-Marquardt steps
STEPS_PER_WIDTH = 4  # of them with one width of the kernel
FOLD_ITERATIONS = 5  # of them, with a part of the squares left out
KERNEL_SIGMAS = 3.0  # width of the robust kernel, in standard deviations of the residuals
NOISE_QUANTILE = 0.8  # of the residuals whose size tells the noise: imperfect lenses make half too few
NOISE_FLOOR_PX = 1e-4  # noise that is assumed at least
PARTS_ALONG = 8  # parts along the longer side of the pattern within which errors may depend on each other
CONVERGED = 1e-6  # share of the cost that a step must gain for the search to go on
STANDARD_ERRORS = 2.0  # by which left-out squares must agree better for another free parameter
FOLDS = 4  # parts that are left out in turn
DEPENDENCE = 2.0  # factor on the stated sigma: neighbouring squares share errors of decoding and of the lens
LARGEST_NOISE_SHARE = 0.005  # of the pattern's width, beyond which no single projector explains what the cameras see
DIFFERENCE_STEP = 1e-6  # change of the intrinsics for derivatives

Fault = Literal["no pair", "no projector", "uncertain"]


@dataclass(frozen=True)
class StaticPlacement:
    """Poses in one world; the baseline of the first two cameras' pair is about one."""

    T_world_camera: Float64[ndarray, "frames 4 4"]  # NaN where a camera could not be placed
    projector: Device
    T_world_projector: Float64[ndarray, "4 4"]
    covariance: Float64[ndarray, "5 5"]  # of its intrinsics, see `values_of`; zero where not free
    noise_px: float  # robust standard deviation of one coordinate, pixels of all devices


@dataclass(frozen=True)
class NoPlacement:
    """What could not be found."""

    fault: Fault
    common: int  # squares that the best two cameras have in common
    sigma_focal: float = np.inf  # share of the focal length


@one_library_thread()
def place_under_static_projector(
    coords: Sequence[Float32[ndarray, "_ _ 2"]], cameras: Sequence[Device], projector: Device, known: bool, stated: bool
) -> StaticPlacement | NoPlacement:
    """Camera poses from the codes as matches; the projector's intrinsics too, unless they are `known`.

    `stated`: the projector is at least a start for them.
    """
    cells = find_cells(coords, projector)
    rays = np.stack([directions(camera, uv) for camera, uv in zip(cameras, cells.uv_camera, strict=True)])
    common = np.isfinite(rays[..., 0]).astype(np.float64)
    most = int((common @ common.T - np.diag(common.sum(1))).max(initial=0)) if len(rays) > 1 else 0
    start = first_pair(rays, cameras)
    if start is None:
        return NoPlacement("no pair", most)
    a, b, T_a_b = start
    T = np.full((len(cameras), 4, 4), np.nan)
    T[a], T[b] = np.eye(4), T_a_b
    T = _grown(T, rays, cells, cameras)
    points = triangulated(rays, T)
    firm = _spread(np.isfinite(points[:, 0]))
    found = _projector(points[firm], cells.uv_projector[firm], projector, known, stated)
    if found is None:
        return NoPlacement("no projector", most)
    device, T_projector = found
    placed = np.flatnonzero(np.isfinite(T[:, 0, 0]))
    scene = StaticScene(
        (*(cameras[k] for k in placed), device), np.concatenate([T[placed], T_projector[None]]), points[firm]
    )
    sightings = _sightings(cells.chosen(firm), placed, with_projector=True)
    adjusted, free = _best_model(scene, sightings, known, projector.model == "DOE")
    if adjusted.noise_px > LARGEST_NOISE_SHARE * projector.w:
        return NoPlacement("no projector", most)
    T[placed] = adjusted.scene.T_world_device[:-1]
    covariance = np.zeros((5, 5))
    covariance[np.ix_(free, free)] = DEPENDENCE**2 * adjusted.covariance
    sigma = float(np.sqrt(covariance[LOG_FOCAL, LOG_FOCAL]))
    if sigma > LARGEST_SIGMA:
        return NoPlacement("uncertain", most, sigma)
    return StaticPlacement(
        T, adjusted.scene.devices[-1], adjusted.scene.T_world_device[-1], covariance, adjusted.noise_px
    )


# Where every camera sees the centres of small squares of the pattern: matches between all cameras at once.


@dataclass(frozen=True)
class PatternCells:
    """Centres of the squares that two cameras or more see."""

    uv_projector: Float64[ndarray, "cells 2"]
    uv_camera: Float64[ndarray, "frames cells 2"]  # NaN where a camera does not see it

    def chosen(self, index: Int64[ndarray, "m"] | Bool[ndarray, "cells"]) -> "PatternCells":
        """Select squares."""
        return PatternCells(self.uv_projector[index], self.uv_camera[:, index])


def find_cells(coords: Sequence[Float32[ndarray, "_ _ 2"]], projector: Device) -> PatternCells:
    """Squares of equal size; in each, a linear map from coordinates to pixels gives the place of the centre."""
    matches = [correspondences_of(uv) for uv in coords]
    side = _side(matches, projector)
    columns, rows = int(np.ceil(projector.w / side)), int(np.ceil(projector.h / side))
    number = np.arange(columns * rows)
    centres = (np.stack([number % columns, number // columns], -1) + 0.5) * side
    seen = np.stack([_centres_seen(*match, centres, side, columns, rows) for match in matches])
    used = np.isfinite(seen[..., 0]).sum(0) > 1
    return PatternCells(centres[used], seen[:, used])


def _side(matches: Sequence[tuple[ndarray, ndarray]], projector: Device) -> float:
    """Side of the squares, so that they hold enough camera pixels in most frames."""
    least = max(projector.w, projector.h) / MOST_ALONG
    density = []
    for _, uv in matches:
        if len(uv):
            column, row = np.floor(uv / (4 * least)).astype(np.int64).clip(0, 4 * MOST_ALONG).T
            squares = np.count_nonzero(np.bincount(row * (4 * MOST_ALONG + 1) + column))
            density.append(len(uv) / (squares * 16 * least**2))
    return max(least, float(np.sqrt(CELL_PIXELS / np.median(density)))) if density else least


def _centres_seen(
    uv_camera: Float64[ndarray, "n 2"],
    uv_projector: Float64[ndarray, "n 2"],
    centres: Float64[ndarray, "cells 2"],
    side: float,
    columns: int,
    rows: int,
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
    good = (count >= FEWEST_IN_CELL) & (np.linalg.det(A) > 1e-6 * count.astype(float) ** 3)
    if not good.any():
        return out
    inverse = np.linalg.inv(A[good])
    linear = inverse @ b[good]
    left = (squares[good] - (linear * b[good]).sum(1)).clip(0).sum(1) / (2 * count[good])
    rough = np.sqrt(left)
    lever = inverse[:, 0, 0] * count[good]  # 1 if the pixels lie around the centre, larger if they lie beside it
    firm = (rough <= ROUGHNESS_MEDIANS * max(float(np.median(rough)), 1e-9)) & (lever < LARGEST_LEVER)
    index = np.flatnonzero(good)[firm]
    out[index] = middle[index] + linear[firm, 0]
    return out


def _sums(cell: Int64[ndarray, "n"], values: Float64[ndarray, "n *k"], cells: int) -> Float64[ndarray, "cells *k"]:
    """Sums of values over the pixels of each square."""
    flat = values.reshape(len(values), -1)
    columns = [np.bincount(cell, flat[:, k], minlength=cells) for k in range(flat.shape[1])]
    return np.stack(columns, 1).reshape(cells, *values.shape[1:])


# Cameras placed by the codes alone: two views first, then one camera after the other against the known points.
# Normalised coordinates are OpenCV's here (y down, looking along +z); poses are those of the devices (along -z).


def image_points(d: Float64[ndarray, "n 3"]) -> Float64[ndarray, "n 2"]:
    """Normalised coordinates of rays, y down."""
    return np.stack([d[:, 0] / -d[:, 2], d[:, 1] / d[:, 2]], -1)


def pose_from_opencv(R: Float64[ndarray, "3 3"], t: Float64[ndarray, "3"]) -> Float64[ndarray, "4 4"]:
    """T_world_device from OpenCV's R, t, which map points of the world to the device."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R.T @ Y_Z_DOWN[:3, :3], -R.T @ t
    return T


def first_pair(
    rays: Float64[ndarray, "frames cells 3"], cameras: Sequence[Device]
) -> tuple[int, int, Float64[ndarray, "4 4"]] | None:
    """Two cameras with many matches and a large angle between them, and the pose of the second against the first."""
    seen = np.isfinite(rays[..., 0])
    common = seen.astype(np.float64) @ seen.T
    pairs = [(a, b) for a, b in combinations(range(len(rays)), 2) if common[a, b] >= FEWEST_COMMON]
    # spread over the whole set, not only neighbours, which share most and turn least
    if len(pairs) > MOST_FIRST_PAIRS:
        pairs = [pairs[k] for k in np.linspace(0, len(pairs) - 1, MOST_FIRST_PAIRS).astype(int)]
    best, best_score = None, 0.0
    for a, b in pairs:
        both = seen[a] & seen[b]
        found = _two_views(rays[a, both], rays[b, both], OUTLIER_PX / cameras[a].fl_x)
        if found is None:
            continue
        T, good = found
        d_b = rays[b, both][good] @ T[:3, :3].T
        angle = np.degrees(np.arccos((rays[a, both][good] * d_b).sum(-1).clip(-1, 1)))
        score = good.sum() * min(float(np.median(angle)), USABLE_ANGLE_DEG)
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
    T[:3] = Y_Z_DOWN[:3, :3] @ T[:3]
    return T, mask[:, 0] > 0


def triangulated(
    rays: Float64[ndarray, "frames cells 3"], T_world_camera: Float64[ndarray, "frames 4 4"]
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
    good = (seen.sum(0) > 1) & (small > 0.5 * np.sin(np.radians(LEAST_ANGLE_DEG)) ** 2)
    points = np.full((rays.shape[1], 3), np.nan)
    points[good] = np.linalg.solve(A[good], b[good][..., None])[..., 0]
    along = np.einsum("fci,fci->fc", d, points[None] - o[:, None])
    behind = (seen & ~(along > 0)).any(0)
    points[behind] = np.nan
    return points


def posed(
    points: Float64[ndarray, "n 3"], d: Float64[ndarray, "n 3"], threshold: float, least_share: float
) -> Float64[ndarray, "4 4"] | None:
    """T_world_device of a device that sees points along unit rays (PnP with RANSAC); None where none fits enough.

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
    points: Float64[ndarray, "n 3"], uv: Float64[ndarray, "n 2"], projector: Device
) -> tuple[Device, Float64[ndarray, "4 4"]] | None:
    """Focal length, principal point (anywhere) and pose of a pinhole projector; its pixels count as square.

    None where the points lie in a plane, or no projector fits.
    """
    extent = np.linalg.svd(points - points.mean(0), compute_uv=False)
    if len(points) < FEWEST_POINTS or extent[2] < LEAST_RELIEF * extent[1]:
        return None
    keep = np.ones(len(points), dtype=bool)
    P = None
    for _ in range(RESECTION_ROUNDS):
        if keep.sum() < FEWEST_POINTS:
            return None
        P = _linear(points[keep], uv[keep])
        x = points @ P[:, :3].T + P[:, 3]
        error = np.linalg.norm(x[:, :2] / x[:, 2:] - uv, axis=1)
        limit = OUTLIER_SIGMAS * MAD_TO_SIGMA * float(np.median(error))
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
    points: Float64[ndarray, "n 3"], uv: Float64[ndarray, "n 2"], projector: Device
) -> Float64[ndarray, "4 4"] | None:
    """Pose of a projector with known intrinsics; None where no pose fits most of the points."""
    d = directions(projector, uv)
    usable = np.isfinite(d[:, 0]) & (d[:, 2] < -1e-3)
    if usable.sum() < FEWEST_POINTS:
        return None
    return posed(points[usable], d[usable], 6.0 / projector.fl_x, 0.3)


# Bundle adjustment of cameras, one projector and points; points are eliminated (Schur complement).
#
# The projector is one more device, whose intrinsics may be free. Residuals are pixels of each device, divided by the
# noise of all. Increments: `T_world_device <- T_world_device exp(v, w)`, then the free intrinsics.


@dataclass(frozen=True)
class StaticScene:
    """What is adjusted: devices (the projector, if there is one, is the last), their poses, and points."""

    devices: tuple[Device, ...]
    T_world_device: Float64[ndarray, "devices 4 4"]
    points: Float64[ndarray, "points 3"]


@dataclass(frozen=True)
class CellSightings:
    """Pixels at which devices see points."""

    device: Int64[ndarray, "n"]
    point: Int64[ndarray, "n"]
    uv: Float64[ndarray, "n 2"]
    cameras: int  # devices from this number on are projectors

    def chosen(self, rows: Bool[ndarray, "n"]) -> "CellSightings":
        """Select sightings."""
        return CellSightings(self.device[rows], self.point[rows], self.uv[rows], self.cameras)


@dataclass(frozen=True)
class AdjustedScene:
    """The scene where the robust cost is smallest."""

    scene: StaticScene
    noise_px: float  # of one coordinate, pixels of all devices
    covariance: Float64[ndarray, "free free"]  # of the projector's free intrinsics


def adjust_scene(
    scene: StaticScene, sightings: CellSightings, free: tuple[int, ...], iterations: int = ITERATIONS
) -> AdjustedScene:
    """Levenberg-Marquardt from a start that is right to within a few pixels; the kernel narrows with the residuals."""
    problem, width = _Adjustment(sightings, free, values_of(scene.devices[-1])), np.inf
    while iterations > 0:
        width = min(width, KERNEL_SIGMAS * _noise(residuals(scene, sightings), scene))
        found = minimise(
            scene,
            partial(problem.equations, width=width),
            problem.moved,
            partial(problem.cost, width=width),
            iterations=min(iterations, STEPS_PER_WIDTH),
            tolerance=CONVERGED,
        )
        if not found.iterations:
            break
        scene, iterations = found.state, iterations - found.iterations
    noise = _noise(residuals(scene, sightings), scene)
    return AdjustedScene(scene, noise, problem.covariance(scene, KERNEL_SIGMAS * noise))


def residuals(scene: StaticScene, s: CellSightings) -> Float64[ndarray, "n 2"]:
    """Pixels by which devices see the points elsewhere than they should; far off where a point is behind."""
    p, out = _in_devices(scene, s), np.zeros((len(s.device), 2))
    for intrinsics, rows in _intrinsics(scene, s):
        uv, front = project(intrinsics, torch.from_numpy(p[rows]))
        out[rows] = np.where(front.numpy()[:, None], uv.numpy() - s.uv[rows], 1e6)
    return out


def _in_devices(scene: StaticScene, s: CellSightings) -> Float64[ndarray, "n 3"]:
    T = scene.T_world_device[s.device]
    return np.einsum("nji,nj->ni", T[:, :3, :3], scene.points[s.point] - T[:, :3, 3])


def _intrinsics(scene: StaticScene, s: CellSightings) -> list[tuple[Intrinsics, ndarray]]:
    """Intrinsics, and the sightings of all devices that share them: these are projected together."""
    groups: dict[Device, list[int]] = {}
    for k, device in enumerate(scene.devices):
        groups.setdefault(device, []).append(k)
    return [
        (Intrinsics.of(device, torch.float64), np.flatnonzero(np.isin(s.device, index)))
        for device, index in groups.items()
    ]


def _noise(r: Float64[ndarray, "n 2"], scene: StaticScene) -> float:
    """Robust standard deviation of one coordinate, of all devices together.

    Apart, that of the cameras or that of the projector could fall to nothing, because three numbers of every point are
    free. Those are allowed for.
    """
    free = 3 * len(scene.points)
    lost = np.sqrt(r.size / max(r.size - free, 1))
    size = float(np.quantile(np.abs(r), NOISE_QUANTILE))
    return max(lost * size / float(ndtri((1 + NOISE_QUANTILE) / 2)), NOISE_FLOOR_PX)


@dataclass(frozen=True)
class _Adjustment:
    """The least-squares problem: which sightings, which intrinsics of the projector are free, and their prior."""

    sightings: CellSightings
    free: tuple[int, ...]
    mean: Float64[ndarray, "5"]  # of the prior

    @property
    def sigma(self) -> Float64[ndarray, "free"]:
        """Standard deviations of the prior."""
        return PRIOR_SIGMA[list(self.free)]

    def departure(self, scene: StaticScene) -> Float64[ndarray, "free"]:
        """Free intrinsics less their means."""
        return (values_of(scene.devices[-1]) - self.mean)[list(self.free)]

    def cost(self, scene: StaticScene, width: float) -> float:
        """Half the robust cost in units of the noise, which is a third of the kernel's width, and that of the prior."""
        r = residuals(scene, self.sightings)
        data = 9 * float(geman_mcclure_cost((r**2).sum(-1) / width**2).sum())
        return (data + float(((self.departure(scene) / self.sigma) ** 2).sum())) / 2

    def moved(
        self, scene: StaticScene, step: tuple[Float64[ndarray, "m"], Float64[ndarray, "points 3"]]
    ) -> StaticScene:
        """The scene after increments of the devices, the intrinsics and the points."""
        devices, T, D = scene.devices, scene.T_world_device.copy(), len(scene.devices)
        v, w = np.split(step[0][: 6 * D].reshape(D, 6), 2, axis=1)
        T[:, :3, 3] += np.einsum("dij,dj->di", T[:, :3, :3], v)
        T[:, :3, :3] = T[:, :3, :3] @ Rotation.from_rotvec(w).as_matrix()
        if self.free:
            values = values_of(devices[-1])
            values[list(self.free)] += step[0][6 * D :].clip(-0.3, 0.3)
            devices = (*devices[:-1], device_with(devices[-1], values))
        return StaticScene(devices, T, scene.points + step[1])

    def equations(self, scene: StaticScene, width: float) -> BlockEquations:
        """Normal equations in units of the noise: devices and intrinsics are shared, each point is a block."""
        m, C = 6 * len(scene.devices) + len(self.free), len(scene.points)
        H, g, coupling = np.zeros((m, m)), np.zeros(m), np.zeros((C, m, 3))
        H_point, g_point = np.zeros((C, 3, 3)), np.zeros((C, 3))
        for columns, point, r, J, weighted, by_point in self._linearised(scene, width):
            H[np.ix_(columns, columns)] += weighted.reshape(-1, len(columns)).T @ J.reshape(-1, len(columns))
            g[columns] += r.ravel() @ weighted.reshape(-1, len(columns))
            # A device sees a point once.
            coupling[point[:, None], columns] = weighted.transpose(0, 2, 1) @ by_point
            weighted_point = self._weight(r, width)[:, None, None] * by_point.transpose(0, 2, 1)
            H_point[point] += weighted_point @ by_point
            g_point[point] += (weighted_point @ r[..., None])[..., 0]
        index = np.arange(m - len(self.free), m)
        H[index, index] += 1 / self.sigma**2
        g[index] += self.departure(scene) / self.sigma**2
        return BlockEquations(H, g, H_point, g_point, coupling)

    def _linearised(self, scene: StaticScene, width: float) -> Iterator[tuple[ndarray, ...]]:
        """For each device: columns of its unknowns, points, residuals, derivatives, these weighted, and by points."""
        s, last = self.sightings, len(scene.devices) - 1
        p, r, by_p = _in_devices(scene, s), residuals(scene, s), np.zeros((len(s.device), 2, 3))
        for intrinsics, rows in _intrinsics(scene, s):
            by_p[rows] = project_jacobian(intrinsics, torch.from_numpy(p[rows])).numpy()
        x, y, z, o = *p.T, np.zeros(len(p))
        hat = np.stack([o, -z, y, z, o, -x, -y, x, o], -1).reshape(-1, 3, 3)
        by_device = np.concatenate([-by_p, by_p @ hat], -1)
        by_point = by_p @ scene.T_world_device[s.device, :3, :3].transpose(0, 2, 1)
        w = self._weight(r, width)[:, None, None]
        for k in range(last + 1):
            rows = np.flatnonzero(s.device == k)
            columns, J = 6 * k + np.arange(6), by_device[rows]
            if k == last and self.free:
                columns = np.append(columns, 6 * last + 6 + np.arange(len(self.free)))
                by_free = [_by_intrinsic(scene.devices[-1], p[rows], one) for one in self.free]
                J = np.concatenate([J, np.stack(by_free, -1)], -1)
            yield columns, s.point[rows], r[rows], J, w[rows] * J, by_point[rows]

    @staticmethod
    def _weight(r: Float64[ndarray, "n 2"], width: float) -> Float64[ndarray, "n"]:
        return geman_mcclure_weight((r**2).sum(-1) / width**2) / (width / 3) ** 2

    def covariance(self, scene: StaticScene, width: float) -> Float64[ndarray, "free free"]:
        """Covariance of the free intrinsics, cluster-robust: errors of points in one part of the pattern may be shared.

        Lenses that are modelled slightly wrong, and edges that are decoded wrong, push neighbouring points the same
        way.
        """
        free = len(self.free)
        if not free:
            return np.zeros((0, 0))
        equations, part = self.equations(scene, width), self._parts(len(scene.points))
        H_inverse = np.linalg.pinv(equations.reduced().H, rcond=1e-13, hermitian=True)
        gradients = -(equations.coupling @ np.linalg.solve(equations.H_block, equations.g_block[..., None]))[..., 0]
        for columns, point, r, _, weighted, _ in self._linearised(scene, width):
            gradients[point[:, None], columns] += np.einsum("nki,nk->ni", weighted, r)
        scores = np.stack([np.bincount(part, one) for one in gradients.T], 1)
        n, m = scores.shape
        meat = scores.T @ scores * (n / max(n - m, n / 4))
        formal, robust = (matrix[m - free :, m - free :] for matrix in (H_inverse, H_inverse @ meat @ H_inverse))
        return with_larger_variances(formal, robust)

    def _parts(self, points: int) -> Int64[ndarray, "points"]:
        """Number of the square part of the projector's image in which each point lies."""
        part, beam = np.zeros(points, dtype=np.int64), self.sightings.device >= self.sightings.cameras
        uv = self.sightings.uv[beam]
        low, high = uv.min(0), uv.max(0)
        cell = ((uv - low) / (high - low).max() * PARTS_ALONG).astype(np.int64).clip(0, PARTS_ALONG - 1)
        part[self.sightings.point[beam]] = cell[:, 1] * PARTS_ALONG + cell[:, 0]
        return part


def _by_intrinsic(projector: Device, p: Float64[ndarray, "n 3"], k: int) -> Float64[ndarray, "n 2"]:
    """Derivative of the projector's pixels by one of its intrinsics."""
    step = DIFFERENCE_STEP * np.eye(len(values_of(projector)))[k]
    ahead, behind = (
        project(Intrinsics.of(device_with(projector, values_of(projector) + x), torch.float64), torch.from_numpy(p))[0]
        for x in (step, -step)
    )
    return (ahead - behind).numpy() / (2 * DIFFERENCE_STEP)


# The steps of the placement.


def _grown(
    T: Float64[ndarray, "frames 4 4"],
    rays: Float64[ndarray, "frames cells 3"],
    cells: PatternCells,
    cameras: Sequence[Device],
) -> Float64[ndarray, "frames 4 4"]:
    """Cameras added one by one, those that see most known points first; everything is adjusted as the set doubles."""
    T, failed, adjusted_with = T.copy(), set(), 0
    while True:
        placed = np.isfinite(T[:, 0, 0])
        if placed.sum() >= 2 * adjusted_with or placed.all():
            T = _adjusted_cameras(T, rays, cells, cameras)
            adjusted_with = int(placed.sum())
        points = triangulated(rays, T)
        seen = (np.isfinite(rays[..., 0]) & np.isfinite(points[:, 0])).sum(1)
        left = sorted((int(k) for k in np.flatnonzero(~placed) if k not in failed), key=lambda k: -seen[k])
        if not left:
            return T if placed.sum() == adjusted_with else _adjusted_cameras(T, rays, cells, cameras)
        k = left[0]
        both = np.isfinite(rays[k, :, 0]) & np.isfinite(points[:, 0])
        enough = both.sum() >= FEWEST_COMMON
        pose = posed(points[both], rays[k, both], 3 * OUTLIER_PX / cameras[k].fl_x, 0.5) if enough else None
        if pose is None:
            failed.add(k)
        else:
            T[k] = pose
            failed.clear()


def _adjusted_cameras(
    T: Float64[ndarray, "frames 4 4"],
    rays: Float64[ndarray, "frames cells 3"],
    cells: PatternCells,
    cameras: Sequence[Device],
) -> Float64[ndarray, "frames 4 4"]:
    """The placed cameras adjusted with the points that they see, without a projector."""
    placed = np.flatnonzero(np.isfinite(T[:, 0, 0]))
    points = triangulated(rays, T)
    firm = _spread(np.isfinite(points[:, 0]))
    scene = StaticScene(tuple(cameras[k] for k in placed), T[placed], points[firm])
    found = adjust_scene(scene, _sightings(cells.chosen(firm), placed, with_projector=False), ()).scene
    T = T.copy()
    T[placed] = found.T_world_device
    return T


def _spread(good: Bool[ndarray, "cells"]) -> Int64[ndarray, "m"]:
    """At most MOST_POINTS of the good cells, evenly among them."""
    index = np.flatnonzero(good)
    return index if len(index) <= MOST_POINTS else index[np.linspace(0, len(index) - 1, MOST_POINTS).astype(np.int64)]


def _sightings(cells: PatternCells, placed: Int64[ndarray, "m"], *, with_projector: bool) -> CellSightings:
    frame, cell = np.nonzero(np.isfinite(cells.uv_camera[placed, :, 0]))
    uv = cells.uv_camera[placed][frame, cell]
    if with_projector:
        every = np.arange(len(cells.uv_projector))
        frame = np.concatenate([frame, np.full(len(every), len(placed))])
        cell, uv = np.concatenate([cell, every]), np.concatenate([uv, cells.uv_projector])
    return CellSightings(frame, cell, uv, len(placed))


def _projector(
    points: Float64[ndarray, "n 3"], uv: Float64[ndarray, "n 2"], projector: Device, known: bool, stated: bool
) -> tuple[Device, Float64[ndarray, "4 4"]] | None:
    """Intrinsics and pose to start from."""
    fixed = known or projector.model == "DOE"
    found = None if fixed else resect(points, uv, projector)
    if found is None and (fixed or stated):
        T = place_known(points, uv, projector)
        return None if T is None else (projector, T)
    return found


_MODELS = (
    (LOG_FOCAL, CX, CY),
    (LOG_FOCAL, CX, CY, K1),
    (LOG_FOCAL, LOG_ASPECT, CX, CY),
    (LOG_FOCAL, LOG_ASPECT, CX, CY, K1),
)


def _best_model(
    scene: StaticScene, sightings: CellSightings, known: bool, doe: bool
) -> tuple[AdjustedScene, tuple[int, ...]]:
    """The smallest model that no larger one beats on left-out points by more than chance."""
    if known:
        return adjust_scene(scene, sightings, ()), ()
    models = _MODELS[:1] if doe else _MODELS
    best = adjust_scene(scene, sightings, models[0])
    chosen, best_loss = models[0], None
    for model in models[1:]:
        larger = adjust_scene(_restarted(best.scene, scene, model), sightings, model)
        extra = [k for k in model if k not in models[0]]
        away = np.abs(values_of(larger.scene.devices[-1]) - values_of(scene.devices[-1]))[extra]
        sigma = np.sqrt(np.diag(larger.covariance))[[model.index(k) for k in extra]]
        if (away < STANDARD_ERRORS * DEPENDENCE * sigma).any():
            continue  # what does not differ from its usual value by more than chance cannot help
        base = _left_out(best.scene, sightings, chosen) if best_loss is None else best_loss
        loss = _left_out(larger.scene, sightings, model)
        gain = base - loss
        if gain.sum() > STANDARD_ERRORS * np.sqrt((gain**2).sum()):
            best, chosen, best_loss = larger, model, loss
    return best, chosen


def _restarted(found: StaticScene, start: StaticScene, free: tuple[int, ...]) -> StaticScene:
    """The scene that was found, with the projector's intrinsics as in the start where they are not free."""
    values = values_of(start.devices[-1])
    values[list(free)] = values_of(found.devices[-1])[list(free)]
    return replace(found, devices=(*found.devices[:-1], device_with(start.devices[-1], values)))


def _left_out(scene: StaticScene, sightings: CellSightings, free: tuple[int, ...]) -> Float64[ndarray, "points"]:
    """Error of the projector's view of every point (capped), when its coordinate takes no part in the fit."""
    out = np.zeros(len(scene.points))
    projector = sightings.device == sightings.cameras
    for fold in range(FOLDS):
        left = projector & (sightings.point % FOLDS == fold)
        found = adjust_scene(scene, sightings.chosen(~left), free, FOLD_ITERATIONS)
        r = residuals(found.scene, sightings.chosen(left))
        width = KERNEL_SIGMAS * found.noise_px
        out[sightings.point[left]] = geman_mcclure_cost((r**2).sum(-1) / width**2)
    return out
