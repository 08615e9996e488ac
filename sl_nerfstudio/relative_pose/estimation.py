"""The pose of the projector relative to the camera, from one frame's coordinates alone, and how far to trust it.

Five degrees of freedom; the length of the baseline cannot be seen in one frame and is set to one.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64
from numpy import ndarray

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.geometry.numerics import MAD_TO_SIGMA, all_finite, geman_mcclure_weight
from sl_nerfstudio.parallel import compiled, one_library_thread
from sl_nerfstudio.relative_pose.candidates import (
    USUAL_COUNTS,
    Candidate,
    RayCounts,
    Separation,
    distinct_fits,
    in_front,
    ranked,
    relative_pose_candidates,
)
from sl_nerfstudio.relative_pose.epipolar import (
    BLOCK_NUMBERS,
    EpipolarFit,
    RayPairs,
    block_count,
    blocks_of,
    correspondences_of,
    covariance,
    fit_epipolar,
    lattice_step,
    ray_pairs,
    sampson,
    subsample,
)

FEWEST_RAYS = 20  # correspondences: enough for five unknowns and a judgement of the result
MOST_SOLUTIONS = 3  # of a frame, the best one included
SOLUTION_SEPARATION: Separation = (0.0354, 0.1)  # more than unfinished refinements differ
INLIER_SIGMAS = 4.0  # noise within which a correspondence agrees with the pose
LEAST_INLIER_SHARE = 0.3  # of the correspondences; with fewer there is no pose
LARGEST_NOISE_SHARE = 0.02  # of the pattern's width; with more noise nothing fits
FEWEST_IN_BLOCK = 20  # correspondences in a square of the pattern from which its own noise is measured
LARGEST_LOCAL_NOISE = 3.0  # in a square, relative to that of the whole frame
ROWS_AT_A_TIME = 64  # of an image whose other pixels are compared with the pose: bounds the memory

# When a frame's correspondences count as degenerate.
LEAST_POINTS = 200  # that agree with the pose
LEAST_BLOCK_SHARE = 30 / 625  # of the squares of the pattern that hold points, so that errors can be judged
LEAST_RELIEF_SIGMAS = 6.0  # departure of the points from a plane, and from a pure rotation, in units of the noise
LEAST_PARALLAX_DEG = 2.0  # between camera and projector ray; below, depth hangs on tiny errors
LARGEST_OUTLIER_SHARE = 0.3  # of the correspondences
LARGEST_NOISE_PX = 2.0  # of the residuals, projector pixels
LARGEST_SIGMA_DEG = (0.5, 1.5)  # of the rotation and of the direction of the baseline
RELIEF_ITERATIONS = 10  # of the robust fits of a plane and of a pure rotation
RELIEF_KERNEL_MEDIANS = 3.0  # width of their kernel, medians of the residuals
RELIEF_SHARE = 0.9  # of the smallest residuals is measured: wrong coordinates are among the others
EPIPOLE_SECTORS = 8  # around the baseline, which all hold rays where an epipole is in view


class RelativePoseError(UserError):
    """A frame whose relative pose cannot be found, with the likely cause and the remedy."""


DegeneracyKind = Literal[
    "few points",
    "small part of the pattern",
    "pure rotation",
    "small parallax",
    "planar",
    "epipole in view",
    "ambiguous",
    "many outliers",
    "poor fit",
    "uncertain",
]


@dataclass(frozen=True)
class Degeneracy:
    """One reason to trust a frame's relative pose less, with the figures that show it.

    The figures of each kind:

    - few points: correspondences that agree with the pose
    - small part of the pattern: squares of the pattern that hold points, and all its squares
    - pure rotation, planar: relief that is left, in projector pixels
    - small parallax: median angle between the rays, in degrees
    - epipole in view: none
    - ambiguous: shares of the correspondences that the second best solution and the best one explain
    - many outliers: share of the correspondences that disagree
    - poor fit: noise of the residuals, in projector pixels
    - uncertain: standard deviations of the rotation and of the baseline's direction, in degrees
    """

    kind: DegeneracyKind
    figures: tuple[float, ...]


@dataclass(frozen=True)
class RelativePose:
    """Pose of the projector in camera axes, baseline one, with its uncertainty.

    `covariance` is that of (w, b): a rotation of the projector about its own centre, in camera axes and radian
    (`R <- exp(w) R`), and a rotation of the baseline (`t <- exp(B b) t`, B = `direction_basis(t)`).
    It allows for errors that neighbouring pixels share, within squares of 1/25 of the pattern; errors of the whole
    frame (intrinsics) are not included, nor is the chance that an alternative is the true pose.
    """

    T_camera_projector: Float64[ndarray, "4 4"]
    covariance: Float64[ndarray, "5 5"]
    inliers: Bool[ndarray, "n"]  # of the correspondences given: epipolar error within four sigma, in front of both
    residual_px: float  # robust standard deviation of the epipolar error, projector pixels
    noise_px: Float64[ndarray, "n"]  # the same around each correspondence; NaN where it has no ray
    explained: float  # share of the correspondences, each by how well it fits at a width common to all solutions
    degeneracies: tuple[Degeneracy, ...]
    alternatives: tuple["RelativePose", ...] = ()  # poses that explain nearly as much, the best first

    @property
    def sigma_rotation_deg(self) -> float:
        """One standard deviation of the rotation's angle (root of the sum over its three axes)."""
        return _angle_sigma_deg(self.covariance[:3, :3])

    @property
    def sigma_direction_deg(self) -> float:
        """One standard deviation of the angle by which the baseline's direction is wrong."""
        return _angle_sigma_deg(self.covariance[3:, 3:])


@one_library_thread()
def estimate_relative_pose(
    uv_camera: Float[ndarray, "n 2"],
    uv_projector: Float[ndarray, "n 2"],
    camera: Device,
    projector: Device,
    seed: int = 0,
    counts: RayCounts = USUAL_COUNTS,
) -> RelativePose:
    """Relative pose of camera and projector from decoded pixels; any projector model, any lens.

    Raises RelativePoseError, with cause and remedy, where there are too few correspondences, or where no pose fits
    most of them.
    """
    rng = np.random.default_rng(seed)
    frame = _Frame.of(uv_camera, uv_projector, camera, projector, counts, rng)
    if len(frame.rays) < FEWEST_RAYS:
        raise RelativePoseError(
            f"{len(frame.rays)} decoded pixels are too few to find the projector's pose (at least {FEWEST_RAYS})\n"
            "    cause:  the pattern was not found, or lies beside the object\n"
            "    remedy: more light, less exposure by other sources, the object larger in the image"
        )
    some = frame.some
    candidates = relative_pose_candidates(some, rng, counts)
    if not candidates:
        raise _no_pose("no relative pose puts most points in front of both devices")
    rivals = [c.fit for c in candidates if c.rivals_best][:MOST_SOLUTIONS]
    solutions = ranked(distinct_fits([fit_epipolar(c.R, c.t, some) for c in rivals], SOLUTION_SEPARATION), some)
    second_best = solutions[1].explained if len(solutions) > 1 else None
    alternatives = tuple(_relative_pose(c, None, (), frame) for c in solutions[1:])
    found = _relative_pose(solutions[0], second_best, alternatives, frame)
    good = float(found.inliers[frame.usable].mean())
    if found.residual_px > LARGEST_NOISE_SHARE * projector.w or good < LEAST_INLIER_SHARE:
        raise _no_pose(
            f"the best relative pose fits {good:.0%} of the decoded pixels to within {found.residual_px:.2g} px"
        )
    return found


@one_library_thread()
def relative_pose_near(
    T_camera_projector: Float64[ndarray, "4 4"],
    uv_camera: Float[ndarray, "n 2"],
    uv_projector: Float[ndarray, "n 2"],
    camera: Device,
    projector: Device,
    seed: int = 0,
) -> RelativePose:
    """The relative pose nearest to one that is known to within a few degrees; no other solution is looked for."""
    frame = _Frame.of(uv_camera, uv_projector, camera, projector, USUAL_COUNTS, np.random.default_rng(seed))
    t = T_camera_projector[:3, 3]
    fit = fit_epipolar(T_camera_projector[:3, :3], t / np.linalg.norm(t), frame.some)
    return _relative_pose(ranked([fit], frame.some)[0], None, (), frame)


@dataclass(frozen=True)
class _Frame:
    """Data that all solutions of a frame share."""

    correspondences: int  # that were given
    usable: Int64[ndarray, "m"]  # those that have rays
    rays: RayPairs
    some: RayPairs  # to which solutions are fitted
    blocks: int  # squares of the whole pattern

    @staticmethod
    def of(
        uv_camera: Float[ndarray, "n 2"],
        uv_projector: Float[ndarray, "n 2"],
        camera: Device,
        projector: Device,
        counts: RayCounts,
        rng: np.random.Generator,
    ) -> "_Frame":
        """The rays of all correspondences, and those that the pose is fitted to."""
        rays, usable = ray_pairs(uv_camera, uv_projector, camera, projector)
        some = rays.chosen(subsample(np.arange(len(rays)), counts.fit, rng))
        return _Frame(len(uv_camera), usable, rays, some, block_count(projector))


def _relative_pose(
    solution: Candidate, second_best: float | None, alternatives: tuple[RelativePose, ...], frame: _Frame
) -> RelativePose:
    """A solution with its covariance, inliers and degeneracies."""
    found = solution.fit
    cov = covariance(found, frame.some)
    degeneracies = _degeneracies(solution, second_best, cov, frame)
    noise = _noise_around(sampson(found.R, found.t, frame.rays), frame.rays, found.noise_px)
    inliers, noise_px = np.zeros(frame.correspondences, dtype=bool), np.full(frame.correspondences, np.nan)
    inliers[frame.usable], noise_px[frame.usable] = agree(found.R, found.t, frame.rays, noise), noise
    T = Similarity(1.0, found.R, found.t).matrix()
    return RelativePose(T, cov, inliers, found.noise_px, noise_px, solution.explained, degeneracies, alternatives)


def agree(
    R: Float64[ndarray, "3 3"], t: Float64[ndarray, "3"], rays: RayPairs, noise_px: Float64[ndarray, "n"]
) -> Bool[ndarray, "n"]:
    """Whether correspondences lie near their epipolar curves for their noise, and in front of both devices."""
    return (np.abs(sampson(R, t, rays)) < INLIER_SIGMAS * noise_px) & in_front(R, t, rays)


def _noise_around(residual: Float64[ndarray, "n"], rays: RayPairs, noise_px: float) -> Float64[ndarray, "n"]:
    """Robust standard deviation of the residuals in the square of the pattern that each lies in.

    A sharp table and a blurred object have different noise; that of the one must not throw out the other.
    """
    _, group, count = np.unique(rays.block, return_inverse=True, return_counts=True)
    order = np.lexsort((np.abs(residual), group))
    middle = np.cumsum(count) - count + count // 2
    noise = MAD_TO_SIGMA * np.abs(residual)[order][middle]
    noise = noise.clip(noise_px, LARGEST_LOCAL_NOISE * noise_px)
    return np.where(count < FEWEST_IN_BLOCK, noise_px, noise)[group]


def _angle_sigma_deg(covariance_rad: Float64[ndarray, "k k"]) -> float:
    return float(np.degrees(np.sqrt(np.trace(covariance_rad))))


def _no_pose(problem: str) -> RelativePoseError:
    return RelativePoseError(
        f"{problem}\n"
        "    cause:  the pattern file is not the one that was projected, the intrinsics are another device's, the "
        "image is mirrored or turned, or most coordinates are wrong\n"
        "    remedy: check pattern and intrinsics (their image sizes first), and look at the decoded coordinates"
    )


# Pixels of the image between those that the pose was found from.


def agreeing_coords(
    coords: Float32[ndarray, "h w 2"], camera: Device, projector: Device, pose: RelativePose
) -> Float32[ndarray, "h w 2"]:
    """The coordinates without those that contradict the pose, which become NaN.

    `pose.inliers` are those of `correspondences_of(coords)`. Pixels between them are judged by the same rule, with the
    noise in their square of the pattern; if all of `pose.inliers` agree, these do.
    """
    known, step = all_finite(coords), lattice_step(*coords.shape[:2])
    agrees = known.copy()
    if step > 1 and not pose.inliers.all():
        noise_px = _noise_by_block(coords, projector, pose)
        R, t = pose.T_camera_projector[:3, :3], pose.T_camera_projector[:3, 3]
        for first in range(0, len(coords), ROWS_AT_A_TIME):
            rows = slice(first, first + ROWS_AT_A_TIME)
            row, column = np.nonzero(known[rows])
            uv_camera = np.stack([column, row + first], -1) + 0.5
            uv_projector = coords[rows][row, column].astype(np.float64)
            rays, usable = ray_pairs(uv_camera, uv_projector, camera, projector)
            good = usable[agree(R, t, rays, noise_px[rays.block])]
            agrees[rows] = False
            agrees[row[good] + first, column[good]] = True
    agrees[::step, ::step][known[::step, ::step]] = pose.inliers
    return np.where(agrees[..., None], coords, np.float32(np.nan))


def _noise_by_block(
    coords: Float32[ndarray, "h w 2"], projector: Device, pose: RelativePose
) -> Float64[ndarray, "blocks"]:
    """Noise in each square of the pattern; that of the whole frame where the pose was found from nothing there."""
    block = blocks_of(correspondences_of(coords)[1], projector)
    measured = np.isfinite(pose.noise_px)
    noise_px = np.full(BLOCK_NUMBERS, pose.residual_px)
    noise_px[block[measured]] = pose.noise_px[measured]
    return noise_px


# Degeneracies.


def _degeneracies(
    solution: Candidate, second_best: float | None, covariance: Float64[ndarray, "5 5"], frame: _Frame
) -> tuple[Degeneracy, ...]:
    """All degeneracies that a frame shows; `second_best`: what another solution explains, if nearly as much."""
    found = solution.fit
    noise = found.noise_px
    inlier = np.abs(found.residual) < INLIER_SIGMAS * noise
    good = frame.some.chosen(inlier)
    blocks = len(np.unique(good.block))
    sigma_deg = _angle_sigma_deg(covariance[:3, :3]), _angle_sigma_deg(covariance[3:, 3:])
    explained = () if second_best is None else (second_best, solution.explained)
    least_relief = LEAST_RELIEF_SIGMAS * noise
    plane, rotation = plane_relief(good), rotation_relief(good)
    parallax_deg = float(np.degrees(np.median(ray_angles(found, good))))
    outliers = 1 - float(inlier.mean())
    too_uncertain = sigma_deg[0] > LARGEST_SIGMA_DEG[0] or sigma_deg[1] > LARGEST_SIGMA_DEG[1]
    rules: tuple[tuple[bool, DegeneracyKind, tuple[float, ...]], ...] = (
        (len(good) < LEAST_POINTS, "few points", (len(good),)),
        (blocks / frame.blocks < LEAST_BLOCK_SHARE, "small part of the pattern", (blocks, frame.blocks)),
        (rotation < least_relief, "pure rotation", (rotation,)),
        (rotation >= least_relief and parallax_deg < LEAST_PARALLAX_DEG, "small parallax", (parallax_deg,)),
        (rotation >= least_relief and plane < least_relief, "planar", (plane,)),
        (epipole_in_view(found, good), "epipole in view", ()),
        (bool(explained), "ambiguous", explained),
        (outliers > LARGEST_OUTLIER_SHARE, "many outliers", (outliers,)),
        (noise > LARGEST_NOISE_PX, "poor fit", (noise,)),
        (too_uncertain, "uncertain", sigma_deg),
    )  # fmt: skip
    return tuple(Degeneracy(kind, tuple(map(float, figures))) for holds, kind, figures in rules if holds)


def ray_angles(found: EpipolarFit, rays: RayPairs) -> Float64[ndarray, "n"]:
    """Angles, in radian, at which camera rays and projector rays meet."""
    d_p = rays.d_projector @ found.R.T
    return np.arctan2(np.linalg.norm(np.cross(rays.d_camera, d_p), axis=-1), (rays.d_camera * d_p).sum(-1))


def epipole_in_view(found: EpipolarFit, rays: RayPairs) -> bool:
    """Whether one device, or its mirror image behind, lies within the cone of rays that see the object."""
    return _surrounded(found.t, rays.d_camera) or _surrounded(found.R.T @ found.t, rays.d_projector)


def _surrounded(axis: Float64[ndarray, "3"], directions: Float64[ndarray, "n 3"]) -> bool:
    """Whether the line of `axis` has directions in all sectors around it."""
    axis = axis * np.sign(axis @ directions.mean(0))
    helper = np.eye(3)[np.abs(axis).argmin()]
    u = np.cross(axis, helper)
    u = u / np.linalg.norm(u)
    angle = np.arctan2(directions @ np.cross(axis, u), directions @ u)
    if axis @ directions.mean(0) <= 0:
        return False
    sector = np.floor((angle + np.pi) / (2 * np.pi / EPIPOLE_SECTORS)).astype(int).clip(0, EPIPOLE_SECTORS - 1)
    return len(np.unique(sector)) == EPIPOLE_SECTORS


def plane_relief(rays: RayPairs) -> float:
    """Robust RMS, in projector pixels, of what the best homography between the two views leaves."""
    w = np.full(len(rays), 1.0)
    r = np.zeros(len(rays))
    d_c, d_p = rays.d_camera, rays.d_projector
    scale = np.linalg.norm(rays.d_projector_by_uv, axis=(1, 2))[:, None]  # radian a pixel: residuals become pixels
    rows = [np.concatenate([_cross_row(d_p, axis)[:, None, k] * d_c for k in range(3)], 1) / scale for axis in range(3)]
    for _ in range(RELIEF_ITERATIONS):
        A = np.concatenate([row * np.sqrt(w)[:, None] for row in rows])
        H = np.linalg.eigh(A.T @ A)[1][:, 0].reshape(3, 3)
        mapped = d_c @ H.T
        mapped = mapped * np.sign((mapped * d_p).sum(-1, keepdims=True))
        r = _error_px(mapped / np.linalg.norm(mapped, axis=-1, keepdims=True).clip(1e-300), rays)
        w = _weights(r)
    return _trimmed_rms(r)


def rotation_relief(rays: RayPairs) -> float:
    """Robust RMS, in projector pixels, of what the best pure rotation between the two devices leaves."""
    w = np.full(len(rays), 1.0)
    r = np.zeros(len(rays))
    for _ in range(RELIEF_ITERATIONS):
        U, _, Vt = np.linalg.svd((rays.d_projector * w[:, None]).T @ rays.d_camera)
        sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
        r = _error_px(rays.d_camera @ ((U * sign) @ Vt).T, rays)
        w = _weights(r)
    return _trimmed_rms(r)


def _weights(r: Float64[ndarray, "n"]) -> Float64[ndarray, "n"]:
    width = RELIEF_KERNEL_MEDIANS * max(float(np.median(r)), 1e-9)
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
    """Length of the change of the pixel that explains the gap between two rays best, by least squares."""
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


def _trimmed_rms(r: Float64[ndarray, "n"]) -> float:
    """RMS of the smallest residuals: all that depart may be one corner of the image, and so may wrong coordinates."""
    kept = np.sort(r)[: max(1, int(RELIEF_SHARE * len(r)))]
    return float(np.sqrt((kept**2).mean()))
