"""Degeneracies: frames whose correspondences determine the relative pose badly, or not at all."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from sl_nerfstudio.relative_pose.epipolar_fit import EpipolarFit
from sl_nerfstudio.relative_pose.ray_pairs import RayPairs
from sl_nerfstudio.relative_pose.relief import plane_relief, rotation_relief
from sl_nerfstudio.relative_pose.settings import RELATIVE_POSE_DEFAULTS, DegeneracyLimits

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
