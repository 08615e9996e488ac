"""Relative pose estimation: the pose of the projector relative to the camera, from one frame's coordinates alone.

Five degrees of freedom; the length of the baseline cannot be seen in one frame and is set to one.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64
from numpy import ndarray

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.numerics import MAD_TO_SIGMA
from sl_nerfstudio.parallel import one_library_thread
from sl_nerfstudio.relative_pose.candidates import (
    Candidate,
    in_front,
    plane_relief,
    ranked,
    relative_pose_candidates,
    rotation_relief,
)
from sl_nerfstudio.relative_pose.epipolar import (
    RELATIVE_POSE_DEFAULTS,
    DegeneracyLimits,
    EpipolarFit,
    RayPairs,
    RelativePoseSettings,
    block_count,
    block_numbers,
    blocks_of,
    correspondences_of,
    covariance,
    distinct_fits,
    fit_epipolar,
    lattice_step,
    ray_pairs,
    sampson,
    subsample,
)

# Degeneracies: frames whose correspondences determine the relative pose badly, or not at all.

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


def find_degeneracies(
    found: EpipolarFit,
    rays: RayPairs,
    inlier: Bool[ndarray, "n"],
    sigma_deg: tuple[float, float],
    explained: tuple[float, float] | None,
    blocks_of_pattern: int,
    limits: DegeneracyLimits = RELATIVE_POSE_DEFAULTS.degeneracy,
) -> tuple[Degeneracy, ...]:
    """All degeneracies that a frame shows.

    Args:
        found: the pose.
        rays: the frame's correspondences.
        inlier: those that agree with the pose.
        sigma_deg: standard deviations of rotation and of the baseline's direction.
        explained: what the second best solution and this one explain, where another explains nearly as much.
        blocks_of_pattern: number of squares of the whole pattern.
        limits: when a frame counts as degenerate.
    """
    good = rays.chosen(inlier)
    blocks = len(np.unique(good.block))
    noise = found.noise_px
    least_relief = limits.least_relief_sigmas * noise
    plane, rotation = plane_relief(good, limits), rotation_relief(good, limits)
    parallax_deg = float(np.degrees(np.median(ray_angles(found, good))))
    outliers = 1 - float(inlier.mean())
    too_uncertain = (
        sigma_deg[0] > limits.largest_sigma_rotation_deg or sigma_deg[1] > limits.largest_sigma_direction_deg
    )
    rules: tuple[tuple[bool, DegeneracyKind, tuple[float, ...]], ...] = (
        (len(good) < limits.least_points, "few points", (len(good),)),
        (blocks / blocks_of_pattern < limits.least_block_share, "small part of the pattern",
         (blocks, blocks_of_pattern)),
        (rotation < least_relief, "pure rotation", (rotation,)),
        (rotation >= least_relief and parallax_deg < limits.least_parallax_deg, "small parallax", (parallax_deg,)),
        (rotation >= least_relief and plane < least_relief, "planar", (plane,)),
        (epipole_in_view(found, good, limits.epipole_sectors), "epipole in view", ()),
        (explained is not None, "ambiguous", explained or ()),
        (outliers > limits.largest_outlier_share, "many outliers", (outliers,)),
        (noise > limits.largest_noise_px, "poor fit", (noise,)),
        (too_uncertain, "uncertain", sigma_deg),
    )  # fmt: skip
    return tuple(Degeneracy(kind, tuple(map(float, figures))) for holds, kind, figures in rules if holds)


def ray_angles(found: EpipolarFit, rays: RayPairs) -> Float64[ndarray, "n"]:
    """Angles, in radian, at which camera rays and projector rays meet."""
    d_p = rays.d_projector @ found.R.T
    return np.arctan2(np.linalg.norm(np.cross(rays.d_camera, d_p), axis=-1), (rays.d_camera * d_p).sum(-1))


def epipole_in_view(
    found: EpipolarFit, rays: RayPairs, sectors: int = RELATIVE_POSE_DEFAULTS.degeneracy.epipole_sectors
) -> bool:
    """Whether one device, or its mirror image behind, lies within the cone of rays that see the object."""
    return _surrounded(found.t, rays.d_camera, sectors) or _surrounded(found.R.T @ found.t, rays.d_projector, sectors)


def _surrounded(axis: Float64[ndarray, "3"], directions: Float64[ndarray, "n 3"], sectors: int) -> bool:
    """Whether the line of `axis` has directions in all sectors around it."""
    axis = axis * np.sign(axis @ directions.mean(0))
    helper = np.eye(3)[np.abs(axis).argmin()]
    u = np.cross(axis, helper)
    u = u / np.linalg.norm(u)
    angle = np.arctan2(directions @ np.cross(axis, u), directions @ u)
    if axis @ directions.mean(0) <= 0:
        return False
    sector = np.floor((angle + np.pi) / (2 * np.pi / sectors)).astype(int).clip(0, sectors - 1)
    return len(np.unique(sector)) == sectors


class RelativePoseError(UserError):
    """A frame whose relative pose cannot be found, with the likely cause and the remedy."""


@dataclass(frozen=True)
class RelativePose:
    """Pose of the projector in camera axes, baseline one, with its uncertainty.

    `covariance` is that of (w, b): a rotation of the projector about its own centre, in camera axes and radian
    (`R <- exp(w) R`), and a rotation of the baseline (`t <- exp(B b) t`, B = `sampson.direction_basis(t)`).
    It allows for errors that neighbouring pixels share, within squares of 1/25 of the pattern; errors of the whole
    frame (intrinsics) are not included, nor is it part of it that an alternative may be the true pose.
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
    settings: RelativePoseSettings = RELATIVE_POSE_DEFAULTS,
) -> RelativePose:
    """Relative pose of camera and projector from decoded pixels; any projector model, any lens.

    Raises RelativePoseError, with cause and remedy, where there are too few correspondences, or where no pose fits
    most of them.
    """
    rng = np.random.default_rng(seed)
    rays, usable = ray_pairs(uv_camera, uv_projector, camera, projector, settings.blocks)
    if len(rays) < settings.fewest:
        raise RelativePoseError(
            f"{len(rays)} decoded pixels are too few to find the projector's pose (at least {settings.fewest})\n"
            "    cause:  the pattern was not found, or lies beside the object\n"
            "    remedy: more light, less exposure by other sources, the object larger in the image"
        )
    some = rays.chosen(subsample(np.arange(len(rays)), settings.most, rng))
    candidates = relative_pose_candidates(some, rng, settings)
    if not candidates:
        raise _no_pose("no relative pose puts most points in front of both devices")
    rivals = [c for c in candidates if c.rivals_best][: settings.candidates.most]
    solutions = distinct_fits((fit_epipolar(c.fit.R, c.fit.t, some, settings.fit) for c in rivals), settings.solutions)
    solutions = ranked(solutions, some, settings)
    frame = _Frame(len(uv_camera), usable, rays, some, block_count(projector, settings.blocks), settings)
    second_best = solutions[1].explained if len(solutions) > 1 else None
    alternatives = tuple(_relative_pose(c, None, (), frame) for c in solutions[1:])
    found = _relative_pose(solutions[0], second_best, alternatives, frame)
    good = float(found.inliers[usable].mean())
    if found.residual_px > settings.largest_noise_share * projector.w or good < settings.least_inlier_share:
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
    settings: RelativePoseSettings = RELATIVE_POSE_DEFAULTS,
) -> RelativePose:
    """The relative pose nearest to one that is known to within a few degrees; no other solution is looked for."""
    rng = np.random.default_rng(seed)
    rays, usable = ray_pairs(uv_camera, uv_projector, camera, projector, settings.blocks)
    some = rays.chosen(subsample(np.arange(len(rays)), settings.most, rng))
    t = T_camera_projector[:3, 3]
    fit = fit_epipolar(T_camera_projector[:3, :3], t / np.linalg.norm(t), some, settings.fit)
    frame = _Frame(len(uv_camera), usable, rays, some, block_count(projector, settings.blocks), settings)
    return _relative_pose(ranked([fit], some, settings)[0], None, (), frame)


@dataclass(frozen=True)
class _Frame:
    """What all solutions of a frame have in common."""

    correspondences: int  # that were given
    usable: Int64[ndarray, "m"]  # those that have rays
    rays: RayPairs
    some: RayPairs  # to which solutions were fitted
    blocks: int  # squares of the whole pattern
    settings: RelativePoseSettings


def _relative_pose(
    solution: Candidate, second_best: float | None, alternatives: tuple[RelativePose, ...], frame: _Frame
) -> RelativePose:
    """A solution with its covariance, inliers and degeneracies."""
    found, settings = solution.fit, frame.settings
    cov = covariance(found, frame.some, settings.fit)
    degeneracies = find_degeneracies(
        found,
        frame.some,
        np.abs(found.residual) < settings.inlier_sigmas * found.noise_px,
        (_angle_sigma_deg(cov[:3, :3]), _angle_sigma_deg(cov[3:, 3:])),
        None if second_best is None else (second_best, solution.explained),
        frame.blocks,
        settings.degeneracy,
    )
    residual = sampson(found.R, found.t, frame.rays)
    noise = _noise_around(residual, frame.rays, found.noise_px, settings)
    good = agree(found.R, found.t, frame.rays, residual, noise, settings)
    inliers, noise_px = np.zeros(frame.correspondences, dtype=bool), np.full(frame.correspondences, np.nan)
    inliers[frame.usable], noise_px[frame.usable] = good, noise
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = found.R, found.t
    return RelativePose(T, cov, inliers, found.noise_px, noise_px, solution.explained, degeneracies, alternatives)


def agree(
    R: Float64[ndarray, "3 3"],
    t: Float64[ndarray, "3"],
    rays: RayPairs,
    residual: Float64[ndarray, "n"],
    noise_px: Float64[ndarray, "n"],
    settings: RelativePoseSettings,
) -> Bool[ndarray, "n"]:
    """Whether correspondences agree with a pose: near their epipolar curves for their noise, in front of both devices.

    `residual` is Sampson's.
    """
    return (np.abs(residual) < settings.inlier_sigmas * noise_px) & in_front(R, t, rays)


def _noise_around(
    residual: Float64[ndarray, "n"], rays: RayPairs, noise_px: float, settings: RelativePoseSettings
) -> Float64[ndarray, "n"]:
    """Robust standard deviation of the residuals in the square of the pattern that each lies in.

    A sharp table and a blurred object have different noise; that of the one must not throw out the other.
    """
    _, group, count = np.unique(rays.block, return_inverse=True, return_counts=True)
    order = np.lexsort((np.abs(residual), group))
    middle = np.cumsum(count) - count + count // 2
    noise = MAD_TO_SIGMA * np.abs(residual)[order][middle]
    noise = noise.clip(noise_px, settings.largest_local_noise * noise_px)
    return np.where(count < settings.fewest_in_block, noise_px, noise)[group]


def _angle_sigma_deg(covariance_rad: Float64[ndarray, "k k"]) -> float:
    return float(np.degrees(np.sqrt(np.trace(covariance_rad))))


def _no_pose(problem: str) -> RelativePoseError:
    return RelativePoseError(
        f"{problem}\n"
        "    cause:  the pattern file is not the one that was projected, the intrinsics are another device's, the "
        "image is mirrored or turned, or most coordinates are wrong\n"
        "    remedy: check pattern and intrinsics (their image sizes first), and look at the decoded coordinates"
    )


# Which coordinates of a frame agree with its relative pose, also between the pixels that the pose was found from.


def agreeing_coords(
    coords: Float32[ndarray, "h w 2"],
    camera: Device,
    projector: Device,
    pose: RelativePose,
    settings: RelativePoseSettings = RELATIVE_POSE_DEFAULTS,
) -> Float32[ndarray, "h w 2"]:
    """The coordinates without those that contradict the pose, which become NaN.

    `pose.inliers` are those of `correspondences_of(coords)`. Pixels between them are judged by the same rule, with the
    noise in their square of the pattern; if all of `pose.inliers` agree, these do.
    """
    known, step = np.isfinite(coords).all(-1), lattice_step(*coords.shape[:2])
    agrees = known.copy()
    if step > 1 and not pose.inliers.all():
        noise_px = _noise_by_block(coords, projector, pose, settings)
        for first in range(0, len(coords), settings.lattice.rows):
            rows = slice(first, first + settings.lattice.rows)
            agrees[rows] = _agree(coords[rows], first, camera, projector, pose, noise_px, settings)
    agrees[::step, ::step][known[::step, ::step]] = pose.inliers
    return np.where(agrees[..., None], coords, np.float32(np.nan))


def _noise_by_block(
    coords: Float32[ndarray, "h w 2"], projector: Device, pose: RelativePose, settings: RelativePoseSettings
) -> Float64[ndarray, "blocks"]:
    """Noise in each square of the pattern; that of the whole frame where the pose was found from nothing there."""
    block = blocks_of(correspondences_of(coords)[1], projector, settings.blocks)
    measured = np.isfinite(pose.noise_px)
    noise_px = np.full(block_numbers(settings.blocks), pose.residual_px)
    noise_px[block[measured]] = pose.noise_px[measured]
    return noise_px


def _agree(
    coords: Float32[ndarray, "h w 2"],
    first_row: int,
    camera: Device,
    projector: Device,
    pose: RelativePose,
    noise_px: Float64[ndarray, "blocks"],
    settings: RelativePoseSettings,
) -> Bool[ndarray, "h w"]:
    """Which pixels of some rows of an image agree."""
    row, column = np.nonzero(np.isfinite(coords).all(-1))
    uv_camera = np.stack([column, row + first_row], -1) + 0.5
    rays, usable = ray_pairs(uv_camera, coords[row, column].astype(np.float64), camera, projector, settings.blocks)
    R, t = pose.T_camera_projector[:3, :3], pose.T_camera_projector[:3, 3]
    good = usable[agree(R, t, rays, sampson(R, t, rays), noise_px[rays.block], settings)]
    out = np.zeros(coords.shape[:2], dtype=bool)
    out[row[good], column[good]] = True
    return out
